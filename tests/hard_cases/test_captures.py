"""Unusable captures are refused in one line that names the file and the remedy."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from neilfpp_method.data.capture import load_capture
from neilfpp_method.data.files.images import write_exr, write_png
from neilfpp_method.data.pixels.backdrop import border_color
from neilfpp_method.data.pixels.dataset import PixelDataset
from neilfpp_method.errors import UserError
from tests.data.formats.scenes import refused
from tests.data.make_capture import make_capture

FLAT = np.full((18, 24, 3), 0.5, np.float32)


# ---------------------------------------------------------------------------------------------------- folders


def test_folder_is_missing(tmp_path: Path) -> None:
    refused(tmp_path / "nowhere", "nowhere", "no such folder")


def test_folder_is_not_a_capture(tmp_path: Path) -> None:
    refused(tmp_path, str(tmp_path), "sfm_scene", "inputs/sfm_scene.json")
    refused(tmp_path, "unknown capture format 'tape'", "sfm_scene", format="tape")
    refused(tmp_path, "not a capture of the format sfm_scene", format="sfm_scene")


# ------------------------------------------------------------------------------------------------- scene file


def tracks(scene: dict) -> dict:
    return scene["camera_track_map"]["images"]


def track(scene: dict) -> dict:
    return tracks(scene)["3"]


def files(scene: dict) -> dict:
    return scene["image_path"]["file_paths"]


def rename_key(scene: dict) -> None:
    tracks(scene)["x"], files(scene)["x"] = tracks(scene).pop("3"), files(scene).pop("3")


def extrinsic(value) -> Callable[[dict], None]:
    return lambda scene: track(scene)["camera"].update(extrinsic=value)


def intrinsic(**values) -> Callable[[dict], None]:
    return lambda scene: track(scene)["camera"]["intrinsic"].update(values)


def path_of_image(value) -> Callable[[dict], None]:
    return lambda scene: files(scene).update({"3": value})


def size(value) -> Callable[[dict], None]:
    return lambda scene: track(scene).update(size=value)


def box(transform) -> Callable[[dict], None]:
    return lambda scene: scene["bbox"].update(transform=np.asarray(transform).tolist())


MIRROR = np.diag([1.0, 1.0, -1.0, 1.0]).tolist()
AWAY = [[1, 0, 0, 1e300], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
BROKEN_SCENES = {
    "no views": (lambda s: (tracks(s).clear(), files(s).clear()), "no images"),
    "no valid views": (lambda s: [t.update(flg=0) for t in tracks(s).values()], "no images"),
    "image without camera": (lambda s: tracks(s).pop("3"), "file_paths.3: an image without a camera"),
    "camera without image": (lambda s: files(s).pop("3"), "images.3: a camera without an image"),
    "file is not there": (path_of_image("images/099.exr"), "there is no"),
    "path is a number": (path_of_image(3), "file_paths.3: not a file name"),
    "path leaves": (path_of_image("../../secret.exr"), "not a path within the capture folder"),
    "path is absolute": (path_of_image("/etc/passwd"), "not a path within the capture folder"),
    "path has a null": (path_of_image("images/\0.exr"), "not a path within the capture folder"),
    "path is too long": (path_of_image("images/" + "x" * 300), "not a path within the capture folder"),
    "key is not a number": (rename_key, "images.x: an image's key is not a number"),
    "no camera": (lambda s: track(s).pop("camera"), "images.3.camera is missing"),
    "no cameras": (lambda s: s.pop("camera_track_map"), "sfm_scene.json: camera_track_map is missing"),
    "a list for an object": (lambda s: s.update(image_path=[]), "image_path: not a JSON object"),
    "3×4 extrinsic": (extrinsic(np.eye(4)[:3].tolist()), "extrinsic: not 16 or 4×4 finite numbers"),
    "ragged extrinsic": (extrinsic([[1, 0], [0]]), "extrinsic: not 16 or 4×4 finite numbers"),
    "extrinsic of text": (extrinsic("eye"), "extrinsic: not 16 or 4×4 finite numbers"),
    "extrinsic with NaN": (extrinsic([float("nan")] * 16), "extrinsic: not 16 or 4×4 finite numbers"),
    "mirror": (extrinsic(MIRROR), "003.exr: the pose mirrors the scene (determinant −1)"),
    "scaled rotation": (extrinsic(np.diag([2, 2, 2, 1]).tolist()), "the extrinsic matrix is not a rotation"),
    "projective": (extrinsic([*np.eye(4)[:3].tolist(), [0, 0, 1, 0]]), "extrinsic matrix is not a rotation"),
    "negative focal": (intrinsic(focal=[-25.0, 25.0]), "003.exr: the focal length is not positive"),
    "zero focal": (intrinsic(focal=0), "003.exr: the focal length is not positive"),
    "focal of almost nothing": (intrinsic(focal=1e-300), "003.exr: the camera has a focal length below"),
    "principal point far away": (intrinsic(ppt=[1e300, 9]), "003.exr: the camera has a focal length below"),
    "camera far away": (extrinsic(AWAY), "003.exr: the camera has a focal length below"),
    "three focals": (intrinsic(focal=[1, 2, 3]), "focal: not 1 or 2 finite numbers"),
    "infinite principal point": (intrinsic(ppt=[float("inf"), 9]), "ppt: not 2 finite numbers"),
    "other size": (size([18, 24]), "003.exr: 24×18 pixels where the camera has 18×24"),
    "size is not whole": (size([24.5, 18]), "size: the image size is not whole"),
    "negative size": (size([-24, 18]), "003.exr: the image size is not positive"),
    "empty box": (box(np.zeros((4, 4))), "bbox.transform: the box is empty"),
    "inverted box": (box(-np.eye(4)), "bbox.transform: the box is empty"),
}  # fmt: skip


@pytest.mark.parametrize("case", BROKEN_SCENES)
def test_scene_file_is_broken(tmp_path: Path, case: str) -> None:
    change, complaint = BROKEN_SCENES[case]
    root = make_capture(tmp_path / "capture")
    path = root / "inputs" / "sfm_scene.json"
    scene = json.loads(path.read_text())
    change(scene)
    path.write_text(json.dumps(scene))
    refused(root, complaint)


@pytest.mark.parametrize("text", [b"", b"{", b"\xff\xfe{}", b"[" * 100_000, b"[]", b"null"])
def test_scene_file_is_not_json_of_a_scene(tmp_path: Path, text: bytes) -> None:
    root = make_capture(tmp_path)
    (root / "inputs" / "sfm_scene.json").write_bytes(text)
    refused(root, "sfm_scene.json")


def test_no_box_and_no_point_cloud(tmp_path: Path) -> None:
    root = make_capture(tmp_path)
    path = root / "inputs" / "sfm_scene.json"
    scene = json.loads(path.read_text())
    scene.pop("bbox")
    path.write_text(json.dumps(scene))
    (root / "inputs" / "model" / "oriented_pcd.ply").unlink()
    refused(root, "sfm_scene.json", "no bbox and no model/oriented_pcd.ply")


@pytest.mark.parametrize(
    "what", ["images/003.exr", "masks/003.png", "model/oriented_pcd.ply", "sfm_scene.json"]
)
def test_links_do_not_lead_out_of_the_capture(tmp_path: Path, what: str) -> None:
    root = make_capture(tmp_path / "capture", masks=True)
    inside, outside = root / "inputs" / what, tmp_path / "outside"
    os.rename(inside, outside)
    inside.symlink_to(outside)
    refused(root, Path(what).name, "not a path within the capture folder", f"{inside.name} is a link")


def test_a_linked_folder_of_images_is_named(tmp_path: Path) -> None:
    root = make_capture(tmp_path / "capture")
    (root / "inputs" / "images").rename(tmp_path / "elsewhere")
    (root / "inputs" / "images").symlink_to(tmp_path / "elsewhere")
    refused(root, "because images is a link; replace the link by a copy of its files")


def test_ambiguous_file_names(tmp_path: Path) -> None:
    root = make_capture(tmp_path)
    images = root / "inputs" / "images"
    (images / "003.exr").rename(images / "003.tif")
    write_png(images / "003.png", (FLAT * 255).astype(np.uint8))
    refused(root, "003.exr: does not exist, and 003.tif and 003.png are both possible")


def test_two_images_with_the_same_name(tmp_path: Path) -> None:
    root = make_capture(tmp_path)
    path = root / "inputs" / "sfm_scene.json"
    path.write_text(path.read_text().replace("images/003.exr", "more/002.exr"))
    (root / "inputs" / "more").mkdir()
    (root / "inputs" / "images" / "003.exr").rename(root / "inputs" / "more" / "002.exr")
    refused(root, "images/002.exr", "more/002.exr", "the same name")


def test_an_image_that_is_not_in_the_scene_file(tmp_path: Path) -> None:
    root = make_capture(tmp_path)
    write_exr(root / "inputs" / "images" / "007.exr", {"RGB": FLAT})
    refused(root, "007.exr: an image without a camera")


# ------------------------------------------------------------------------------------------------------ split


@pytest.mark.parametrize(
    "text", ["{", "[]", '{"train": []}', '{"test": 3}', '{"test": [99]}', '{"test": ["x"]}', '{"test": [[]]}']
)
def test_split_file_is_broken(tmp_path: Path, text: str) -> None:
    root = make_capture(tmp_path)
    (root / "split.json").write_text(text)
    refused(root, "split.json")


def test_an_impossible_split_is_refused(tmp_path: Path) -> None:
    root = make_capture(tmp_path)
    refused(root, "every 1-th view cannot be held out", test_every=1)
    refused(root, "cannot be held out", test_every=-2)
    refused(root, "there is no view 'seven'", test=["seven"])


# ----------------------------------------------------------------------------------------------------- pixels


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, -0.25])
def test_impossible_pixel_values(tmp_path: Path, bad: float) -> None:
    root = make_capture(tmp_path)
    broken = FLAT.copy()
    broken[3, 4:7, 1] = bad
    for name in ("002", "004"):
        write_exr(root / "inputs" / "images" / f"{name}.exr", {"RGB": broken})
    refused(root, "002.exr: 3 pixels are NaN, infinite or negative, and 1 more image")


def test_image_cannot_be_read(tmp_path: Path) -> None:
    root = make_capture(tmp_path)
    path = root / "inputs" / "images" / "004.exr"
    whole = path.read_bytes()
    for content in (b"", b"not an image", whole[: len(whole) - 40]):
        path.write_bytes(content)
        refused(root, "004.exr: cannot be read")


def test_hdr_and_ldr_mixed(tmp_path: Path) -> None:
    root = make_capture(tmp_path)
    (root / "inputs" / "images" / "005.exr").unlink()
    write_png(root / "inputs" / "images" / "005.png", (FLAT * 255).astype(np.uint8))
    refused(root, "000.exr is HDR and", "005.png is LDR")


def test_mask_shows_no_object(tmp_path: Path) -> None:
    root = make_capture(tmp_path, masks=True)
    write_png(root / "inputs" / "masks" / "001.png", np.zeros((18, 24), np.uint8))
    refused(root, "masks/001.png: the mask shows no object")


def test_mask_with_another_size(tmp_path: Path) -> None:
    root = make_capture(tmp_path, masks=True)
    write_png(root / "inputs" / "masks" / "001.png", np.ones((9, 12), np.uint8))
    refused(root, "masks/001.png: 12×9 pixels where the camera has 24×18; make the mask again")


def test_alpha_shows_no_object(tmp_path: Path) -> None:
    root = make_capture(tmp_path)
    write_exr(root / "inputs" / "images" / "001.exr", {"RGBA": np.zeros((18, 24, 4), np.float32)})
    refused(root, "images/001.exr: the mask shows no object")


def test_no_views_to_load(tmp_path: Path) -> None:
    capture = load_capture(make_capture(tmp_path))
    with pytest.raises(UserError, match="no views to load"):
        PixelDataset(capture, [])


def test_all_pixels_are_black(tmp_path: Path) -> None:
    root = make_capture(tmp_path)
    for i in range(6):
        write_exr(root / "inputs" / "images" / f"{i:03d}.exr", {"RGB": np.zeros_like(FLAT)})
    capture = load_capture(root)
    with pytest.raises(UserError, match="all pixels of the object are black"):
        PixelDataset(capture, capture.views).median_radiance()


def test_images_of_one_pixel(tmp_path: Path) -> None:
    capture = load_capture(make_capture(tmp_path, size=(1, 1), background=0.3))
    pixels = PixelDataset(capture, capture.views)
    batch = pixels.sample(20)
    assert (batch.image_gradient == 0).all()
    assert batch.directions.isfinite().all()
    assert border_color(pixels) is not None
