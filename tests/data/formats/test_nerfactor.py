"""The synthetic scenes of NeRFactor and TensoIR: a folder with metadata.json and rgba.png for each view."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from neilfpp_method.data.cameras.projection import project
from neilfpp_method.data.capture import load_capture
from neilfpp_method.data.files.images import read_image, write_png
from tests.data.formats.scenes import POINTS, WIDTH, local, material, opengl_pose, refused
from tests.data.make_capture import CENTER, RADIUS

FOCAL = 25.0
FOLDERS = ["train_000", "train_001", "train_002", "test_000", "test_001", "val_000"]


def scene(root: Path) -> Path:
    material(root, hdr=False)
    for i, name in enumerate(FOLDERS):
        image, mask = (read_image(root / kind / f"{i:03d}.png").pixels for kind in ("images", "masks"))
        layers = np.rint(255 * np.concatenate([image, mask[..., :1]], axis=-1)).astype(np.uint8)
        for file in ("rgba.png", "rgba_sunset.png", "albedo.png"):
            write_png(root / name / file, layers)
        metadata = {
            "cam_angle_x": 2 * np.arctan(WIDTH / 2 / FOCAL),
            "cam_transform_mat": ",".join(map(str, opengl_pose(i).ravel())),
            "envmap": "sunset",
            "imw": WIDTH,
        }
        (root / name / "metadata.json").write_text(json.dumps(metadata))
    return root


def test_cameras_masks_and_splits(tmp_path: Path) -> None:
    capture = load_capture(scene(tmp_path))
    assert capture.format == "nerfactor"
    assert [view.name for view in capture.train_views] == FOLDERS[:3]
    assert [view.name for view in capture.test_views] == FOLDERS[3:5]
    for i, view in enumerate(capture.views):
        assert view.image == tmp_path / view.name / "rgba.png"
        x, y, z = local(i).T
        expected = np.stack([FOCAL * x / z + 12, FOCAL * y / z + 9], axis=1)
        assert np.abs(project(view.camera, torch.from_numpy(POINTS)).pixel.numpy() - expected).max() < 1e-6
    assert capture.scene_from == "masks"
    assert np.allclose(capture.normalization.center, CENTER, atol=0.3 * RADIUS)


@pytest.mark.parametrize(
    ("entry", "value", "complaint"),
    [
        ("cam_transform_mat", "1,0,0", "cam_transform_mat: not 16 finite numbers"),
        ("cam_transform_mat", ",".join(["1"] * 16), "not a rotation and a translation"),
        ("cam_transform_mat", None, "cam_transform_mat: not a word"),
        ("cam_angle_x", 40, "cam_angle_x: 40 is not an angle of view"),
    ],
)
def test_bad_metadata_is_refused(tmp_path: Path, entry: str, value: object, complaint: str) -> None:
    path = scene(tmp_path) / "test_001" / "metadata.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {entry: value}))
    refused(tmp_path, str(path), complaint)


def test_the_first_training_view_may_be_missing(tmp_path: Path) -> None:
    shutil.rmtree(scene(tmp_path) / "train_000")
    assert [view.name for view in load_capture(tmp_path).train_views] == FOLDERS[1:3]


def test_missing_files_are_refused(tmp_path: Path) -> None:
    (scene(tmp_path) / "train_001" / "rgba.png").unlink()
    refused(tmp_path, "train_001: there is no rgba.png", "copy those of one light to rgba.png")
    (tmp_path / "train_001" / "metadata.json").unlink()
    refused(tmp_path, "train_001/metadata.json", "No such file")


def test_test_views_without_an_image_are_left_out(tmp_path: Path) -> None:
    """In NeRFactor's scenes only the cameras of some of them are known."""
    (scene(tmp_path) / "test_000" / "rgba.png").unlink()
    assert [view.name for view in load_capture(tmp_path).test_views] == ["test_001"]
