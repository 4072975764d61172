"""Blender's transforms_train.json and transforms_test.json: NeRF's synthetic scenes and Stanford-ORB."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from neilfpp_method.data.cameras.projection import project
from neilfpp_method.data.capture import load_capture
from neilfpp_method.data.files.images import read_image, write_png
from tests.data.formats.scenes import POINTS, VIEWS, WIDTH, local, material, opengl_pose, refused
from tests.data.make_capture import CENTER, RADIUS

FOCAL = 25.0
ANGLE = 2 * np.arctan(WIDTH / 2 / FOCAL)
SPLITS = {"train": (0, 1, 2, 3), "test": (4, 5)}


def scene(root: Path, hdr: bool = True) -> Path:
    """Stanford-ORB's layout; if `hdr` is False, NeRF's layout, with alpha instead of masks."""
    material(root, hdr=hdr)
    suffix = ".exr" if hdr else ".png"
    for split, numbers in SPLITS.items():
        frames = []
        (root / split).mkdir()
        (root / f"{split}_mask").mkdir()
        for k, i in enumerate(numbers):
            source, mask = root / "images" / f"{i:03d}{suffix}", root / "masks" / f"{i:03d}.png"
            if hdr:
                source.rename(root / split / f"{k:04d}.exr")
                mask.rename(root / f"{split}_mask" / f"{k:04d}.png")
            else:
                layers = np.concatenate(
                    [read_image(source).pixels, read_image(mask).pixels[..., :1]], axis=-1
                )
                write_png(root / split / f"{k:04d}.png", np.rint(255 * layers).astype(np.uint8))
            path = f"{split}/{k:04d}" if hdr else f"./{split}/{k:04d}"
            frames.append({"file_path": path, "transform_matrix": opengl_pose(i).tolist(), "rotation": 0.01})
        content = {"camera_angle_x": ANGLE, "frames": frames}
        (root / f"transforms_{split}.json").write_text(json.dumps(content))
    return root


@pytest.mark.parametrize("hdr", [True, False])
def test_cameras_masks_and_splits(tmp_path: Path, hdr: bool) -> None:
    capture = load_capture(scene(tmp_path, hdr))
    assert capture.format == "blender"
    assert capture.hdr == hdr
    assert len(capture.views) == VIEWS
    assert [view.name for view in capture.train_views] == [
        f"train-{k:04d}" for k in range(4)
    ]  # 0000 is in both folders
    assert [view.name for view in capture.test_views] == ["test-0000", "test-0001"]
    for i, view in enumerate(capture.views):
        x, y, z = local(i).T
        expected = np.stack([FOCAL * x / z + 12, FOCAL * y / z + 9], axis=1)
        assert np.abs(project(view.camera, torch.from_numpy(POINTS)).pixel.numpy() - expected).max() < 1e-6
    masks = [view.mask and view.mask.parent.name for view in capture.views]
    assert masks == (["train_mask"] * 4 + ["test_mask"] * 2 if hdr else [None] * 6)
    assert capture.scene_from == "masks"
    assert np.allclose(capture.normalization.center, CENTER, atol=0.3 * RADIUS)


def test_without_a_test_file_every_eighth_view_is_held_out(tmp_path: Path) -> None:
    (scene(tmp_path) / "transforms_test.json").unlink()
    capture = load_capture(tmp_path)
    assert [view.name for view in capture.views] == ["0000", "0001", "0002", "0003"]
    assert not capture.test


def test_bad_files_are_refused(tmp_path: Path) -> None:
    path = scene(tmp_path / "capture") / "transforms_test.json"
    content = json.loads(path.read_text())
    path.write_text(json.dumps(content | {"frames": [content["frames"][0] | {"file_path": "../../secret"}]}))
    refused(tmp_path / "capture", "secret: not a path within the capture")
    path.write_text(json.dumps(content | {"camera_angle_x": 4.0}))
    refused(tmp_path / "capture", "transforms_test.json: camera_angle_x: 4 is not an angle of view")
    path.write_text(json.dumps(content | {"frames": [content["frames"][0] | {"file_path": "test/0009"}]}))
    refused(tmp_path / "capture", "there is no", "test/0009")


def test_missing_images_are_counted(tmp_path: Path) -> None:
    root = scene(tmp_path / "capture")
    files = sorted((root / "train").iterdir())
    for file in files[1:]:
        file.unlink()
    missing, listed = len(files) - 1, len(json.loads((root / "transforms_train.json").read_text())["frames"])
    refused(root, f"({missing} of {listed} images are missing)", "remove the entry")
    (root / "train" / f"{files[1].stem}.webp").touch()
    refused(root, f"only {files[1].stem}.webp, whose format is not read", "convert it")
