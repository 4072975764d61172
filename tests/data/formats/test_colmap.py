"""COLMAP models that pycolmap writes, and a model without rigs, as older versions of COLMAP wrote it."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch
from scipy.spatial.transform import Rotation

from neilfpp_method.data.cameras.lens import LENSES, PINHOLES
from neilfpp_method.data.cameras.projection import project
from neilfpp_method.data.capture import load_capture
from neilfpp_method.data.files.images import read_image, write_png
from neilfpp_method.errors import UserError
from tests.data.cameras.test_lens import COEFFICIENTS
from tests.data.formats.scenes import (
    FOCAL,
    HEIGHT,
    POINTS,
    POSES,
    PRINCIPAL,
    VIEWS,
    WIDTH,
    local,
    material,
    pinhole_pixels,
    refused,
)
from tests.data.make_capture import CENTER, RADIUS

MODELS = (*sorted(PINHOLES), *LENSES)


def colmap_camera(model: str) -> pycolmap.Camera:
    single = pycolmap.Camera.create_from_model_name(0, model, 1.0, 1, 1).params_info.startswith("f,")
    focal = FOCAL[:1] if single else FOCAL
    params = [*focal, *PRINCIPAL, *COEFFICIENTS.get(model, ())]
    return pycolmap.Camera(model=model, width=WIDTH, height=HEIGHT, params=params, camera_id=1)


def reconstruction(camera: pycolmap.Camera, names: list[str] | None = None) -> pycolmap.Reconstruction:
    """The six views, points on the sphere, and some points far away from it."""
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(camera)
    for i, pose in enumerate(POSES):
        name = names[i] if names else f"{i:03d}.png"
        image = pycolmap.Image(name=name, camera_id=1, image_id=i + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose[:3]))
    points = np.random.default_rng(2).normal(size=(600, 3))
    points = CENTER + RADIUS * points / np.linalg.norm(points, axis=1, keepdims=True)
    for point in (*points, 300 * CENTER, -200 * CENTER):
        model.add_point3D(point, pycolmap.Track(), np.zeros(3, np.uint8))
    return model


def write(root: Path, model: pycolmap.Reconstruction, place: str = "sparse/0", text: bool = False) -> Path:
    folder = root / place
    folder.mkdir(parents=True, exist_ok=True)
    (model.write_text if text else model.write_binary)(folder)
    return root


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("model", MODELS)
def test_every_camera_model_projects_as_in_colmap(tmp_path: Path, model: str, text: bool) -> None:
    camera = colmap_camera(model)
    capture = load_capture(write(material(tmp_path, masks=None), reconstruction(camera), text=text), "colmap")
    assert capture.views[0].camera.lens is None or model not in PINHOLES
    for i, view in enumerate(capture.views):
        seen = project(view.camera, torch.from_numpy(POINTS)).pixel.numpy()
        assert np.abs(seen - camera.img_from_cam(local(i))).max() < 1e-4


@pytest.mark.parametrize("place", ["sparse/0", "sparse", ".", "colmap/sparse/0", "dense/sparse"])
def test_models_are_found_in_the_folders_that_colmap_uses(tmp_path: Path, place: str) -> None:
    write(material(tmp_path), reconstruction(colmap_camera("PINHOLE")), place)
    capture = load_capture(tmp_path)
    assert capture.format == "colmap"
    assert [view.name for view in capture.views] == [f"{i:03d}" for i in range(VIEWS)]
    assert (
        capture.views[2].image == tmp_path / "images" / "002.exr"
    )  # the model lists the tone-mapped 002.png
    assert capture.hdr


def test_a_model_from_before_rigs(tmp_path: Path) -> None:
    folder = material(tmp_path) / "sparse"
    folder.mkdir()
    (folder / "cameras.txt").write_text(
        f"# Camera list\n1 PINHOLE {WIDTH} {HEIGHT} {FOCAL[0]} {FOCAL[1]} {PRINCIPAL[0]} {PRINCIPAL[1]}\n"
    )
    lines = []
    for i in reversed(range(VIEWS)):  # in no order
        x, y, z, w = Rotation.from_matrix(POSES[i][:3, :3]).as_quat()
        t = POSES[i][:3, 3]
        lines += [f"{i + 1} {w} {x} {y} {z} {t[0]} {t[1]} {t[2]} 1 {i:03d}.exr", "1.5 2.5 -1"]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    (folder / "points3D.txt").write_text("1 0.3 -0.2 0.5 0 0 0 0.5 1 0\n")
    capture = load_capture(tmp_path)
    assert capture.scene_from == "masks"  # one point is too few
    for i, view in enumerate(capture.views):
        assert view.name == f"{i:03d}"
        assert (
            np.abs(project(view.camera, torch.from_numpy(POINTS)).pixel.numpy() - pinhole_pixels(i)).max()
            < 1e-6
        )


def test_the_scene_box_comes_from_the_sparse_points(tmp_path: Path) -> None:
    write(material(tmp_path, masks=None), reconstruction(colmap_camera("PINHOLE")))
    capture = load_capture(tmp_path)
    assert capture.scene_from == "points"
    assert np.allclose(capture.normalization.center, CENTER, atol=0.05 * RADIUS)
    assert RADIUS < capture.normalization.scale < 1.15 * RADIUS
    assert capture.point_cloud is None  # sparse points have no normals


def test_the_scene_box_comes_from_the_points_of_the_object(tmp_path: Path) -> None:
    model = reconstruction(colmap_camera("PINHOLE"))
    for point in np.random.default_rng(4).uniform(-20, 20, (600, 3)):  # the room
        model.add_point3D(point, pycolmap.Track(), np.zeros(3, np.uint8))
    write(material(tmp_path, masks=None), model, "colmap/sparse/0")
    assert load_capture(tmp_path).normalization.scale < 3  # the focus of the cameras, not the room
    (tmp_path / "cloud.ply").rename(tmp_path / "object_point_cloud.ply")
    capture = load_capture(tmp_path)
    assert np.allclose(capture.normalization.center, CENTER, atol=0.05 * RADIUS)
    assert RADIUS < capture.normalization.scale < 1.15 * RADIUS


def test_the_dense_cloud_and_masks_are_found(tmp_path: Path) -> None:
    write(material(tmp_path), reconstruction(colmap_camera("PINHOLE")))
    (tmp_path / "cloud.ply").rename(tmp_path / "fused.ply")
    (tmp_path / "masks" / "003.png").rename(
        tmp_path / "masks" / "003.png.png"
    )  # COLMAP's own name for 003.png
    capture = load_capture(tmp_path)
    assert capture.point_cloud == tmp_path / "fused.ply"
    assert [view.mask.name for view in capture.views][2:4] == ["002.png", "003.png.png"]


def test_masks_in_a_folder_called_mask_with_labels(tmp_path: Path) -> None:
    write(material(tmp_path), reconstruction(colmap_camera("PINHOLE")))
    (tmp_path / "masks").rename(tmp_path / "mask")
    expected = [read_image(view.mask).mask for view in load_capture(tmp_path).views]
    assert 0 < np.mean(expected) < 1
    for file in (tmp_path / "mask").iterdir():
        write_png(file, (read_image(file).mask > 0.5).astype(np.uint8))
    for view, mask in zip(load_capture(tmp_path).views, expected, strict=True):
        assert np.array_equal(read_image(view.mask).mask > 0.5, mask > 0.5)


def test_masks_of_some_views_are_counted(tmp_path: Path) -> None:
    write(material(tmp_path), reconstruction(colmap_camera("PINHOLE")))
    next((tmp_path / "masks").iterdir()).unlink()
    assert f"mask files: {VIEWS - 1} of {VIEWS}" in load_capture(tmp_path).summary


@pytest.mark.parametrize("text", [False, True])
def test_the_largest_of_several_models_is_read(tmp_path: Path, text: bool) -> None:
    model = reconstruction(colmap_camera("PINHOLE"))
    write(material(tmp_path, masks=None), model, "sparse/1", text)
    for i in range(2, VIEWS + 1):
        model.deregister_frame(i)
    write(tmp_path, model, "sparse/0", text)
    assert len(load_capture(tmp_path).views) == VIEWS


def test_images_with_suffixes_in_capital_letters(tmp_path: Path) -> None:
    write(material(tmp_path, masks=None), reconstruction(colmap_camera("PINHOLE")))
    for file in (tmp_path / "images").iterdir():
        file.rename(file.with_suffix(".EXR"))
    assert {view.image.suffix for view in load_capture(tmp_path).views} == {".EXR"}


def test_masks_of_other_names_are_an_error(tmp_path: Path) -> None:
    write(material(tmp_path), reconstruction(colmap_camera("PINHOLE")))
    for mask in sorted((tmp_path / "masks").iterdir()):
        mask.rename(mask.with_name(f"mask_{mask.name}"))
    with pytest.raises(UserError, match=r"no mask is named after an image.* mask_000\.png; .* 000\.png"):
        load_capture(tmp_path)


def test_images_with_the_same_name_in_two_folders(tmp_path: Path) -> None:
    images = material(tmp_path, masks=None) / "images"
    names = [f"{side}/{i:03d}.png" for i in range(3) for side in ("left", "right")]
    for i, name in enumerate(names):
        (images / name).parent.mkdir(exist_ok=True)
        (images / f"{i:03d}.exr").rename((images / name).with_suffix(".exr"))
    write(tmp_path, reconstruction(colmap_camera("PINHOLE"), names))
    capture = load_capture(tmp_path)
    assert [view.name for view in capture.views] == [
        f"{side}-{i:03d}" for side in ("left", "right") for i in range(3)
    ]
    assert np.allclose(capture.views[1].camera.w2c, POSES[2])


def test_a_model_from_windows(tmp_path: Path) -> None:
    images = material(tmp_path, masks=None) / "images"
    (images / "left").mkdir()
    for i in range(VIEWS):
        (images / f"{i:03d}.exr").rename(images / "left" / f"{i:03d}.exr")
    write(tmp_path, reconstruction(colmap_camera("PINHOLE"), [f"left\\{i:03d}.png" for i in range(VIEWS)]))
    assert [view.image for view in load_capture(tmp_path).views] == [
        images / "left" / f"{i:03d}.exr" for i in range(VIEWS)
    ]


# ---------------------------------------------------------------------------------------------------- refused


def test_images_that_are_missing_or_outside(tmp_path: Path) -> None:
    write(material(tmp_path, masks=None), reconstruction(colmap_camera("PINHOLE")))
    for i in (0, 4):
        (tmp_path / "images" / f"{i:03d}.exr").unlink()
    capture = load_capture(tmp_path)
    assert [(view.name, view.index) for view in capture.views] == [
        ("001", 0),
        ("002", 1),
        ("003", 2),
        ("005", 3),
    ]
    assert np.allclose(capture.views[0].camera.w2c, POSES[1])
    assert capture.missing == ("000.png", "004.png")
    for i in (1, 2):
        (tmp_path / "images" / f"{i:03d}.exr").unlink()
    refused(tmp_path, "000.png (4 of 6 images are missing)", "put the image there")
    (tmp_path / "images").rename(tmp_path / "elsewhere")
    refused(tmp_path, "no images/000.png", "folder images")


def test_reduced_images_only(tmp_path: Path) -> None:
    """As of mip-NeRF 360, whose cameras are those of the full images."""
    root = write(material(tmp_path, "images_4", masks=None), reconstruction(colmap_camera("PINHOLE")))
    refused(root, "there is no images/000.png, only images_4, which the cameras do not fit", "--scale 0.25")


def test_a_path_that_leaves_the_capture(tmp_path: Path) -> None:
    names = [f"{i:03d}.png" for i in range(5)] + ["../../secret.png"]
    root = tmp_path / "capture"
    write(material(root, masks=None), reconstruction(colmap_camera("PINHOLE"), names))
    (root / "images" / "000.exr").rename(tmp_path / "secret.exr")
    refused(root, "secret.png: not a path within the capture")


def test_a_model_behind_a_link_out_of_the_capture(tmp_path: Path) -> None:
    write(tmp_path / "other", reconstruction(colmap_camera("PINHOLE")))
    root = material(tmp_path / "capture", masks=None)
    os.symlink(tmp_path / "other" / "sparse", root / "sparse")
    refused(root, "not a path within the capture")


@pytest.mark.parametrize("file", ["cameras.bin", "images.bin", "points3D.bin", "rigs.bin", "frames.bin"])
@pytest.mark.parametrize("damage", ["garbage", "empty", "short", "boastful"])
def test_damaged_models(tmp_path: Path, file: str, damage: str) -> None:
    write(material(tmp_path, masks=None), reconstruction(colmap_camera("PINHOLE")))
    path = tmp_path / "sparse" / "0" / file
    data = path.read_bytes()
    count = int.from_bytes(data[:8], "little")
    damaged = {
        "garbage": b"\xff" * 200,
        "empty": b"",
        "short": data[: len(data) * 2 // 3],
        "boastful": (count + 1000).to_bytes(8, "little") + data[8:],
    }
    path.write_bytes(damaged[damage])
    refused(tmp_path, "sparse")


def test_a_frame_without_its_image(tmp_path: Path) -> None:
    write(material(tmp_path, masks=None), reconstruction(colmap_camera("PINHOLE")), text=True)
    path = tmp_path / "sparse" / "0" / "images.txt"
    path.write_text("\n".join(line for line in path.read_text().splitlines() if "004.png" not in line) + "\n")
    refused(tmp_path, "sparse", "image 5 in frame 5 does not exist")


def test_names_with_spaces_in_a_text_model(tmp_path: Path) -> None:
    """COLMAP writes the whole name and reads it up to the first space."""
    names = [f"view {i:03d}.exr" for i in range(VIEWS)]
    root = write(material(tmp_path, masks=None), reconstruction(colmap_camera("PINHOLE"), names), text=True)
    for file in (root / "images").iterdir():
        file.rename(file.with_name(f"view {file.name}"))
    refused(root, "end at their first space in a text model, as 'view'; export the model as binary")
    shutil.rmtree(root / "sparse")
    write(root, reconstruction(colmap_camera("PINHOLE"), names))
    assert [view.name for view in load_capture(root).views] == [f"view {i:03d}" for i in range(VIEWS)]


def test_a_name_that_is_not_utf_8(tmp_path: Path) -> None:
    write(material(tmp_path, masks=None), reconstruction(colmap_camera("PINHOLE")))
    path = tmp_path / "sparse" / "0" / "images.bin"
    path.write_bytes(path.read_bytes().replace(b"004.png", b"00\xff.png"))
    refused(tmp_path, "sparse", "utf-8")


def test_a_pose_that_is_not_finite(tmp_path: Path) -> None:
    write(material(tmp_path, masks=None), reconstruction(colmap_camera("PINHOLE")))
    path = tmp_path / "sparse" / "0" / "frames.bin"
    data = path.read_bytes()
    quaternion = np.array(pycolmap.Rigid3d(POSES[2][:3]).rotation.quat)[[3, 0, 1, 2]].tobytes()
    assert quaternion in data
    path.write_bytes(data.replace(quaternion, np.full(4, np.nan).tobytes()))
    refused(tmp_path, "the camera has a number that is not finite")


def test_a_model_without_images_and_a_panorama(tmp_path: Path) -> None:
    write(material(tmp_path, masks=None), pycolmap.Reconstruction())
    refused(tmp_path, "no registered image")
    sphere = pycolmap.Camera(
        model="EQUIRECTANGULAR", width=WIDTH, height=HEIGHT, params=[WIDTH, HEIGHT], camera_id=1
    )
    write(tmp_path, reconstruction(sphere))
    refused(tmp_path, "EQUIRECTANGULAR", "perspective")


def test_a_camera_with_another_size_than_its_image(tmp_path: Path) -> None:
    camera = colmap_camera("PINHOLE")
    camera.width = 48
    write(material(tmp_path, masks=None), reconstruction(camera))
    refused(tmp_path, "000.exr", "24×18 pixels where the camera has 48×18")


def test_rigs_of_several_cameras_with_observations(tmp_path: Path) -> None:
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig, options.num_points3D = (
        1,
        3,
        2,
        60,
    )
    options.camera_width, options.camera_height = WIDTH, HEIGHT
    options.sensor_from_rig_rotation_stddev, options.sensor_from_rig_translation_stddev = 5.0, 0.1
    model = pycolmap.synthesize_dataset(options)
    images = material(tmp_path, masks=None) / "images"
    listed = sorted(model.images.values(), key=lambda image: image.name)
    for i, image in enumerate(listed):
        (images / f"{i:03d}.exr").rename((images / image.name).with_suffix(".exr"))
    capture = load_capture(write(tmp_path, model))
    assert len(capture.views) == 6
    points = np.array([point.xyz for point in model.points3D.values()])
    for view, image in zip(capture.views, listed, strict=True):
        assert view.name == Path(image.name).stem
        seen = project(view.camera, torch.from_numpy(points)).pixel.numpy()
        expected = np.array([image.project_point(point) for point in points])
        assert np.abs(seen - expected).max() < 1e-6
