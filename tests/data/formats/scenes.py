"""The sphere of `make_capture` as files for other layouts: images, masks, cameras and known projections."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from neilfpp_method.data.capture import load_capture
from neilfpp_method.data.pixels.dataset import PixelDataset
from neilfpp_method.errors import UserError
from tests.data.make_capture import CENTER, RADIUS, camera_pose, make_capture

VIEWS = 6
WIDTH, HEIGHT = 24, 18
FOCAL, PRINCIPAL = (1.4 * HEIGHT, 1.5 * HEIGHT), (WIDTH / 2 + 0.5, HEIGHT / 2 - 0.25)
POSES = [camera_pose(i, VIEWS) for i in range(VIEWS)]
POINTS = CENTER + np.random.default_rng(5).uniform(-RADIUS, RADIUS, (40, 3))


def material(root: Path, folder: str = "images", masks: str | None = "masks", hdr: bool = True) -> Path:
    """Write images 000 to 005 and their masks into folders of `root`, and nothing else; returns `root`."""
    source = make_capture(root / "source", VIEWS, (WIDTH, HEIGHT), hdr=hdr, masks=masks is not None)
    (root / folder).parent.mkdir(parents=True, exist_ok=True)
    (source / "inputs" / "images").rename(root / folder)
    if masks is not None:
        (source / "inputs" / "masks").rename(root / masks)
    (source / "inputs" / "model" / "oriented_pcd.ply").rename(root / "cloud.ply")
    for path in sorted(source.rglob("*"), reverse=True):
        path.rmdir() if path.is_dir() else path.unlink()
    source.rmdir()
    return root


def local(i: int, points: np.ndarray = POINTS) -> np.ndarray:
    """Points in the frame of camera i: x right, y down, z forward."""
    return points @ POSES[i][:3, :3].T + POSES[i][:3, 3]


def pinhole_pixels(i: int, points: np.ndarray = POINTS) -> np.ndarray:
    """Pixels of points in the pinhole camera of `make_capture`, computed in NumPy without the package."""
    x, y, z = local(i, points).T
    return np.stack([FOCAL[0] * x / z + PRINCIPAL[0], FOCAL[1] * y / z + PRINCIPAL[1]], axis=1)


def opengl_pose(i: int, world: np.ndarray | None = None) -> np.ndarray:
    """Camera to world with OpenGL's axes, in a world rotated by `world`."""
    c2w = np.linalg.inv(POSES[i])
    c2w[:3, 1:3] *= -1
    turn = np.eye(4)
    turn[:3, :3] = np.eye(3) if world is None else world
    return turn @ c2w


def _load(root: Path, **options) -> PixelDataset:
    capture = load_capture(root, **options)
    return PixelDataset(capture, capture.views)


def refused(root: Path, *words: str, **options) -> None:
    """Check that loading the capture and its pixels raises a one-line `UserError` with a remedy and all these
    words.
    """
    with pytest.raises(UserError) as caught:
        _load(root, **options)
    message = str(caught.value)
    assert "\n" not in message
    assert caught.value.remedy
    for word in words:
        assert word in message
