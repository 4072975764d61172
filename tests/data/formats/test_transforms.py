"""transforms.json as nerfstudio and other programs write it, compared with NumPy and OpenCV."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import trimesh

from neilfpp_method.data.cameras.projection import project
from neilfpp_method.data.capture import load_capture
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
    opengl_pose,
    pinhole_pixels,
    refused,
)
from tests.data.make_capture import CENTER, RADIUS

INTRINSICS = {
    "fl_x": FOCAL[0],
    "fl_y": FOCAL[1],
    "cx": PRINCIPAL[0],
    "cy": PRINCIPAL[1],
    "w": WIDTH,
    "h": HEIGHT,
}


def scene(
    root: Path, world: np.ndarray | None = None, per_frame: bool = False, hdr: bool = True, **entries
) -> Path:
    """Write a transforms.json; `world` rotates its frame."""
    suffix = ".exr" if hdr else ".png"
    frames = []
    for i in range(VIEWS):
        frame = {"file_path": f"images/{i:03d}{suffix}", "transform_matrix": opengl_pose(i, world).tolist()}
        frames.append(frame | INTRINSICS if per_frame else frame)
    content = {"camera_model": "OPENCV", **({} if per_frame else INTRINSICS), "frames": frames, **entries}
    (material(root, hdr=hdr) / "transforms.json").write_text(json.dumps(content))
    return root


def edit(root: Path, change: Callable[[dict], object]) -> Path:
    path = root / "transforms.json"
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))
    return root


def seen_pixels(root: Path, points: np.ndarray = POINTS) -> list[np.ndarray]:
    return [project(view.camera, torch.from_numpy(points)).pixel.numpy() for view in load_capture(root).views]


def opencv_pixels(i: int, coefficients: list[float], fisheye: bool) -> np.ndarray:
    k = np.array([[FOCAL[0], 0, PRINCIPAL[0]], [0, FOCAL[1], PRINCIPAL[1]], [0, 0, 1]])
    points, zero = local(i)[:, None], np.zeros(3)
    oracle = cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
    return oracle(points, zero, zero, k, np.array(coefficients))[0][:, 0]


# ---------------------------------------------------------------------------------------------------- cameras


@pytest.mark.parametrize("per_frame", [False, True])
def test_opengl_cameras_become_opencv_cameras(tmp_path: Path, per_frame: bool) -> None:
    seen = seen_pixels(scene(tmp_path, per_frame=per_frame))
    assert max(np.abs(seen[i] - pinhole_pixels(i)).max() for i in range(VIEWS)) < 1e-6


def test_a_world_with_y_up_is_unchanged(tmp_path: Path) -> None:
    y_up = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # z becomes y
    root = scene(tmp_path, world=y_up, applied_transform=np.pad(y_up, ((0, 0), (0, 1))).tolist())
    seen = seen_pixels(root, POINTS @ y_up.T)
    assert max(np.abs(seen[i] - pinhole_pixels(i)).max() for i in range(VIEWS)) < 1e-6
    assert np.allclose(load_capture(root).normalization.center, y_up @ CENTER, atol=0.2 * RADIUS)


@pytest.mark.parametrize(
    ("model", "names", "fisheye"),
    [
        ("OPENCV", {"k1": -0.12, "k2": 0.03, "p1": 0.002, "p2": -0.001}, False),
        ("OPENCV", {"k1": -0.12, "k2": 0.03, "p1": 0.002, "p2": -0.001, "k3": 0.01}, False),
        ("OPENCV_FISHEYE", {"k1": 0.03, "k2": -0.005, "k3": 0.002, "k4": -0.001}, True),
        (None, {"k1": 0.03, "k2": -0.005, "k3": 0.002, "k4": -0.001}, True),  # is_fisheye
        (None, {"k1": -0.12, "k2": 0.03, "p1": 0.002, "p2": -0.001}, False),
        ("OPENCV_FISHEYE", {"k1": 0.0, "k2": 0.0, "k3": 0.0, "k4": 0.0}, True),
        ("SIMPLE_RADIAL", {"k1": -0.1, "k2": 0.0, "p1": 0.0, "p2": 0.0}, False),
    ],
)
@pytest.mark.parametrize("place", ["file", "frame"])
def test_lenses_project_as_in_opencv(
    tmp_path: Path, model: str | None, names: dict[str, float], fisheye: bool, place: str
) -> None:
    scene(tmp_path, camera_model=model, **({} if model else {"is_fisheye": fisheye}))

    def add(content: dict) -> None:
        for target in (content,) if place == "file" else content["frames"]:
            target.update(names)

    seen = seen_pixels(edit(tmp_path, add))
    expected = [opencv_pixels(i, list(names.values()), fisheye) for i in range(VIEWS)]
    assert max(np.abs(a - b).max() for a, b in zip(seen, expected, strict=True)) < 1e-6


def test_a_file_from_windows(tmp_path: Path) -> None:
    """Its path separators, and the byte order mark that its editors write."""
    scene(tmp_path)
    edit(
        tmp_path,
        lambda c: [f.update(file_path=".\\" + f["file_path"].replace("/", "\\")) for f in c["frames"]],
    )
    path = tmp_path / "transforms.json"
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert [view.image for view in load_capture(tmp_path).views] == [
        tmp_path / "images" / f"{i:03d}.exr" for i in range(VIEWS)
    ]
    upward = path.read_text("utf-8-sig").replace(".\\\\images", "..\\\\images")
    path.write_text(upward)
    refused(tmp_path, "not a path within the capture")


def test_a_field_of_view_defines_the_focal_length(tmp_path: Path) -> None:
    scene(tmp_path)

    def change(content: dict) -> None:
        for name in INTRINSICS:
            del content[name]
        content["camera_angle_x"] = 2 * np.arctan(WIDTH / 2 / 30.0)

    camera = load_capture(edit(tmp_path, change)).views[0].camera
    assert (camera.width, camera.height) == (WIDTH, HEIGHT)  # from the image
    assert camera.fx == camera.fy == pytest.approx(30.0)
    assert (camera.cx, camera.cy) == (WIDTH / 2, HEIGHT / 2)
    camera = (
        load_capture(edit(tmp_path, lambda c: c.update(camera_angle_y=2 * np.arctan(HEIGHT / 2 / 40.0))))
        .views[0]
        .camera
    )
    assert camera.fy == pytest.approx(40.0)


@pytest.mark.parametrize(
    ("of_frame", "fx", "fy"),
    [
        ({"camera_angle_x": 2 * np.arctan(WIDTH / 2 / 30.0)}, 30.0, 30.0),
        ({"camera_angle_y": 2 * np.arctan(HEIGHT / 2 / 40.0)}, 40.0, 40.0),
        ({"camera_angle_x": 2 * np.arctan(WIDTH / 2 / 30.0), "fl_y": 31.0}, 30.0, 31.0),
        ({"camera_angle_x": 2 * np.arctan(WIDTH / 2 / 30.0), "fl_x": 29.0}, 29.0, FOCAL[1]),
        ({"fl_x": 29.0}, 29.0, FOCAL[1]),
        ({"fl_y": 31.0}, FOCAL[0], 31.0),
        ({"fl_x": 29.0, "fl_y": 31.0}, 29.0, 31.0),
    ],
)
def test_the_focal_length_of_a_frame_takes_precedence(
    tmp_path: Path, of_frame: dict[str, float], fx: float, fy: float
) -> None:
    root = edit(scene(tmp_path), lambda content: content["frames"][1].update(of_frame))
    first, second = (view.camera for view in load_capture(root).views[:2])
    assert (first.fx, first.fy) == FOCAL
    assert (second.fx, second.fy) == pytest.approx((fx, fy))


@pytest.mark.parametrize("angle", [0.0, -0.7, 4.0])
@pytest.mark.parametrize("in_frame", [False, True])
def test_an_impossible_angle_of_view_beside_a_focal_length_is_refused(
    tmp_path: Path, angle: float, in_frame: bool
) -> None:
    scene(tmp_path)
    edit(tmp_path, lambda c: (c["frames"][1] if in_frame else c).update(camera_angle_x=angle, fl_x=30.0))
    place = "frames.1.camera_angle_x" if in_frame else "camera_angle_x"
    refused(tmp_path, f"transforms.json: {place}: {angle:g} is not an angle of view", "radians")


# ------------------------------------------------------------------------------------------- files and splits


def test_masks_and_the_scene_box_from_them(tmp_path: Path) -> None:
    scene(tmp_path)
    assert load_capture(tmp_path).scene_from == "cameras"
    assert "guessed from the cameras only" in load_capture(tmp_path).summary

    def add(content: dict) -> None:
        for i, frame in enumerate(content["frames"]):
            frame["mask_path"] = f"./masks/{i:03d}.png"

    capture = load_capture(edit(tmp_path, add))
    assert capture.scene_from == "masks"
    assert [view.mask.name for view in capture.views] == [f"{i:03d}.png" for i in range(VIEWS)]
    assert np.allclose(capture.normalization.center, CENTER, atol=0.25 * RADIUS)


@pytest.mark.parametrize("normals", [True, False])
def test_the_point_cloud(tmp_path: Path, normals: bool) -> None:
    scene(tmp_path, ply_file_path="cloud.ply")
    if not normals:
        points = trimesh.load(tmp_path / "cloud.ply").vertices
        trimesh.PointCloud(points).export(tmp_path / "cloud.ply")
    capture = load_capture(tmp_path)
    assert capture.scene_from == "points"
    assert np.allclose(capture.normalization.center, CENTER, atol=0.05 * RADIUS)
    assert capture.point_cloud == (tmp_path / "cloud.ply" if normals else None)


def test_lists_of_files_split_the_views(tmp_path: Path) -> None:
    files = [f"images/{i:03d}.exr" for i in range(VIEWS)]
    scene(tmp_path, train_filenames=files[:4], val_filenames=files[4:5], test_filenames=files[5:])
    assert load_capture(tmp_path).test == {"005"}
    assert load_capture(edit(tmp_path, lambda c: c.pop("test_filenames"))).test == {"004", "005"}
    assert load_capture(tmp_path, test_every=2).test == {"001", "003", "005"}
    refused(
        edit(tmp_path, lambda c: c.update(train_filenames=["images/009.exr"])),
        "train_filenames: names a file",
    )


def test_missing_images_are_left_out(tmp_path: Path) -> None:
    """As in the fox of instant-ngp, whose cameras were written before a quarter of the images was deleted."""
    files = [f"images/{i:03d}.exr" for i in range(VIEWS)]
    scene(tmp_path, train_filenames=files[:4], test_filenames=files[4:])
    for gone in ("001", "004"):
        (tmp_path / "images" / f"{gone}.exr").unlink()
    capture = load_capture(tmp_path)
    assert [(view.name, view.index) for view in capture.views] == [
        ("000", 0),
        ("002", 1),
        ("003", 2),
        ("005", 3),
    ]
    assert capture.test == {"005"}
    assert capture.missing == (files[1], files[4])
    warning = f"warning: 2 of {VIEWS} listed images are missing and left out; the first is {files[1]}"
    assert warning in capture.summary.splitlines()
    poses = np.stack([view.camera.w2c for view in capture.views])
    assert np.allclose(poses, np.stack([POSES[i] for i in (0, 2, 3, 5)]))


def test_the_kind_of_files_determines_the_response(tmp_path: Path) -> None:
    assert load_capture(scene(tmp_path / "hdr")).hdr
    assert not load_capture(scene(tmp_path / "ldr", hdr=False)).hdr
    assert load_capture(edit(tmp_path / "ldr", lambda c: c.update(response="linear"))).hdr


# ---------------------------------------------------------------------------------------------------- refused


def frame(content: dict) -> dict:
    return content["frames"][2]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda c: c.pop("frames"), ["frames is missing"]),
        (lambda c: c.update(frames=[]), ["no frames"]),
        (lambda c: c.update(frames={"0": {}}), ["frames: not a JSON list"]),
        (lambda c: c["frames"].append(3), ["frames.6: not a JSON object"]),
        (lambda c: frame(c).pop("file_path"), ["frames.2.file_path is missing"]),
        (lambda c: frame(c).update(file_path=7), ["frames.2.file_path: not a file name"]),
        (
            lambda c: [f.update(file_path=f"images/x{i}.png") for i, f in enumerate(c["frames"][:4])],
            ["transforms.json: there is no", "x0.png (4 of 6 images are missing); put the image there"],
        ),
        (lambda c: frame(c).update(file_path="../secret.exr"), ["secret.exr: not a path within the capture"]),
        (lambda c: frame(c).update(file_path="/etc/hostname"), ["hostname: not a path within the capture"]),
        (lambda c: frame(c).update(mask_path="../secret.exr"), ["secret.exr: not a path within the capture"]),
        (lambda c: frame(c).update(mask_path="masks/x.png"), ["frames.2.mask_path: there is no"]),
        (lambda c: c.update(ply_file_path="../secret.exr"), ["secret.exr: not a path within the capture"]),
        (lambda c: c.update(ply_file_path="x.ply"), ["ply_file_path: there is no"]),
        (lambda c: frame(c).pop("transform_matrix"), ["frames.2.transform_matrix is missing"]),
        (
            lambda c: frame(c).update(transform_matrix=[[1, 0], [0, 1]]),
            ["frames.2.transform_matrix: not 4×4 or 3×4"],
        ),
        (
            lambda c: frame(c).update(transform_matrix=(2 * np.eye(4)).tolist()),
            ["transform_matrix: not a rotation"],
        ),
        (
            lambda c: frame(c).update(transform_matrix=np.diag([-1.0, 1, 1, 1]).tolist()),
            ["002.exr: the pose mirrors the scene", "negate one axis"],
        ),
        (lambda c: c.pop("fl_x"), ["frames.0: no focal length"]),
        (lambda c: c.update(fl_x=-3), ["the focal length is not positive"]),
        (lambda c: c.update(fl_x="wide"), ["fl_x: not a finite number"]),
        (lambda c: c.update(w=12.5), ["w: not a positive whole number"]),
        (lambda c: c.update(w=1e400), ["w: not a finite number"]),
        (lambda c: c.update(w=48), ["24×18 pixels where the camera has 48×18"]),
        (
            lambda c: c.update(camera_model="EQUIRECTANGULAR"),
            ["camera_model: EQUIRECTANGULAR is not one of OPENCV, ", "cut panoramas into perspective images"],
        ),
        (lambda c: c.update(k4=0.1), ["k4 is not supported for the camera model OPENCV"]),
        (lambda c: c.update(k6=0.1), ["k6 is not supported for the camera model OPENCV"]),
        (
            lambda c: c.update(k5=0.1, camera_model="OPENCV_FISHEYE"),
            ["k5 is not supported for the camera model OPENCV_FISHEYE"],
        ),
        (lambda c: c["frames"].append(frame(c)), ["002.exr: listed twice", "list it once"]),
    ],
)
def test_bad_entries_are_refused(tmp_path: Path, change: Callable[[dict], object], words: list[str]) -> None:
    (tmp_path / "secret.exr").touch()
    refused(edit(scene(tmp_path / "capture"), change), *words)


def test_an_image_with_an_exif_orientation(tmp_path: Path) -> None:
    """Some programs rotate the pixels by the EXIF orientation before they estimate the camera, without
    changing the file.
    """
    refused(
        edit(scene(tmp_path), lambda c: c.update(w=HEIGHT, h=WIDTH)),
        "18×24; rotate the pixels as the EXIF data of the image states",
    )


def test_invalid_json_is_refused(tmp_path: Path) -> None:
    scene(tmp_path)
    for text in ("", "{", "[" * 100_000, "\x00"):
        (tmp_path / "transforms.json").write_text(text)
        refused(tmp_path, "transforms.json")
