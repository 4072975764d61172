"""Captures that are refused."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from neilfpp_method.data.files.images import read_image, write_exr, write_png
from tests.calls import refused


def edit_scene(change: Callable[[dict, dict], object]) -> Callable[[Path], None]:
    """Change the cameras and the file names of a scene file."""

    def apply(root: Path) -> None:
        path = root / "inputs" / "sfm_scene.json"
        scene = json.loads(path.read_text())
        change(scene["camera_track_map"]["images"], scene["image_path"]["file_paths"])
        path.write_text(json.dumps(scene))

    return apply


def paint(value: float) -> Callable[[Path], None]:
    """Put one pixel of a value into an image."""

    def apply(root: Path) -> None:
        path = root / "inputs" / "images" / "002.exr"
        pixels = read_image(path).pixels.copy()
        pixels[3, 4, 1] = value
        write_exr(path, {"RGB": pixels})

    return apply


def truncate(name: str) -> Callable[[Path], None]:
    def apply(root: Path) -> None:
        path = root / "inputs" / name
        path.write_bytes(path.read_bytes()[:-40])

    return apply


BROKEN = {
    "missing folder": (shutil.rmtree, "no such folder"),
    "not a capture": (lambda root: (root / "inputs" / "sfm_scene.json").unlink(), "inputs/sfm_scene.json"),
    "no images": (
        edit_scene(lambda cameras, files: (cameras.clear(), files.clear())),
        "sfm_scene.json: no images",
    ),
    "image without camera": (
        edit_scene(lambda cameras, _: cameras.pop("3")),
        "paths.3: an image without a camera",
    ),
    "camera without image": (
        edit_scene(lambda _, files: files.pop("3")),
        "images.3: a camera without an image",
    ),
    "image is not there": (lambda root: (root / "inputs" / "images" / "003.exr").unlink(), "003.exr"),
    "another size": (
        edit_scene(lambda cameras, _: cameras["3"].update(size=[48, 36])),
        "003.exr: 24×18 pixels",
    ),
    "NaN": (paint(np.nan), "002.exr: 1 pixels are NaN"),
    "infinite": (paint(np.inf), "002.exr: 1 pixels are NaN, infinite"),
    "negative": (paint(-0.25), "002.exr: 1 pixels are NaN, infinite or negative"),
    "unreadable image": (truncate("images/004.exr"), "004.exr: cannot be read"),
    "unreadable scene": (truncate("sfm_scene.json"), "sfm_scene.json: not valid JSON"),
    "empty mask": (
        lambda root: write_png(root / "inputs" / "masks" / "001.png", np.zeros((18, 24), np.uint8)),
        "masks/001.png: the mask shows no object",
    ),
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_capture_that_cannot_be_used(tmp_path, capfd, capture, case):
    spoil, complaint = BROKEN[case]
    root = tmp_path / "spoilt"
    shutil.copytree(capture, root)
    spoil(root)
    command = [
        "train",
        "--data",
        root,
        "--out",
        tmp_path / "runs" / "new",
        "--preset",
        "tiny",
        "--device",
        "cpu",
    ]
    refused(capfd, command, root, complaint, leaves=tmp_path)


@pytest.mark.parametrize("folder", ["", "front", "inputs"])
def test_a_folder_of_photographs_has_to_be_prepared(tmp_path, capfd, folder):
    """Nothing but pictures: no cameras are known yet, and `neilfpp prepare` finds them."""
    photos = tmp_path / "photos"
    (photos / folder).mkdir(parents=True)
    for name in ("001.jpg", "002.JPG", "003.dng", ".004.jpg", "notes.txt"):
        (photos / folder / name).write_bytes(b"")
    words = (f"{photos}: 3 photographs and no cameras", f"run neilfpp prepare {photos} --out CAPTURE")
    refused(capfd, ["train", "--data", photos], *words, leaves=tmp_path)


@pytest.mark.parametrize(
    ("found", "reason", "remedy"),
    [
        ("transforms_test.json", "no transforms_train.json", "add the file of the training views"),
        ("test_000/metadata.json", "no train_000/metadata.json", "add the folders of the training views"),
        ("cams/00000000_cam.txt", "cameras of MVSNet and BlendedMVS are not read", "transforms.json"),
    ],
)
def test_cameras_that_cannot_be_used(tmp_path, capfd, found, reason, remedy):
    """The images have cameras, so that there are none is not what is wrong."""
    for name in (found, "test_000/rgba.png"):
        (tmp_path / "lego" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "lego" / name).write_text("{}")
    words = (f"{tmp_path / 'lego'}: there is {found}, but {reason}", remedy)
    refused(capfd, ["inspect", tmp_path / "lego"], *words, leaves=tmp_path)
    refused(capfd, ["train", "--data", tmp_path / "lego"], *words, leaves=tmp_path)


def test_the_folder_above_a_capture(tmp_path, capfd, capture):
    shutil.copytree(capture, tmp_path / "scenes" / "lego")
    write_png(tmp_path / "scenes" / "001.png", np.zeros((4, 4, 3), np.uint8))
    words = (f"{tmp_path / 'scenes'}: the capture is in the sub-folder lego", f"give {tmp_path}/scenes/lego")
    refused(capfd, ["inspect", tmp_path / "scenes"], *words, leaves=tmp_path)


def test_a_point_cloud_that_cannot_be_read(tmp_path, capfd, capture):
    root = tmp_path / "broken"
    shutil.copytree(capture, root)
    (root / "inputs" / "model" / "oriented_pcd.ply").write_bytes(b"ply")
    command = ["train", "--data", root, "--out", tmp_path / "run", "--preset", "tiny", "--device", "cpu"]
    command += ["--config.host.loss.point-cloud", "0.1"]
    refused(capfd, command, root, "oriented_pcd.ply", leaves=tmp_path)
