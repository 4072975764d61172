"""Readers of arrays that lie beside a capture or in a run folder."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import torch
import trimesh
from scipy.io import savemat

from neilfpp_method.data.capture import Capture, load_capture
from neilfpp_method.data.pixels.dataset import PixelDataset
from neilfpp_method.errors import UserError
from neilfpp_method.evaluate.published.dtu import read_scan
from neilfpp_method.evaluate.published.truth_files import read_array
from neilfpp_method.schedule import Stage
from neilfpp_method.train.skipped import FOLDER, FORMAT, load_step
from tests.data.make_capture import make_capture

__all__ = [
    *("make_numbers", "make_pixels", "make_scan", "make_step"),
    *("read_numbers", "read_pixels", "read_scanned", "read_step"),
]

SHAPE = (5, 7, 3)


def make_numbers(folder: Path) -> list[Path]:
    """Arrays of a protocol's truth."""
    values = np.random.default_rng(5).random(SHAPE)
    np.save(folder / "single.npy", values.astype(np.float32))
    np.save(folder / "big-endian.npy", values.astype(">f8"))
    np.save(folder / "columns.npy", np.asfortranarray(values))
    return sorted(folder.iterdir())


def read_numbers(folder: Path, damaged: Path) -> None:
    values = read_array(damaged, SHAPE)
    assert values.shape == SHAPE
    assert values.dtype == np.float32


def make_scan(folder: Path) -> list[Path]:
    """The scanner's data of DTU beside a capture."""
    make_capture(folder / "scan24")
    masks, points = folder / "ObsMask", folder / "Points" / "stl"
    masks.mkdir()
    points.mkdir(parents=True)
    mask = {"ObsMask": np.ones((5, 5, 5), np.uint8), "BB": np.array([[0.0, 0, 0], [4, 4, 4]]), "Res": [[1.0]]}
    savemat(masks / "ObsMask24_10.mat", mask)
    savemat(masks / "Plane24.mat", {"P": np.array([[0.0], [0], [1], [5]])}, do_compression=True)
    trimesh.PointCloud(np.random.default_rng(6).random((20, 3))).export(points / "stl024_total.ply")
    return [masks / "ObsMask24_10.mat", masks / "Plane24.mat", points / "stl024_total.ply"]


def read_scanned(folder: Path, damaged: Path) -> None:
    scan = read_scan(_capture(folder / "scan24"))
    assert scan.mask.ndim == 3
    assert scan.cell > 0
    for values in (scan.low, scan.high, scan.plane, scan.points):
        assert np.isfinite(values).all()


def make_step(folder: Path) -> list[Path]:
    """A skipped step."""
    rays = {name: torch.rand(4, 3) for name in ("origins", "directions", "color")}
    numbers = {name: torch.rand(4) for name in ("mask", "mask_known", "image_gradient")}
    contents = {
        "format": FORMAT,
        "step": 7,
        "stage": Stage.JOINT.value,
        "share": 0.5,
        "batch": {**rays, **numbers, "view": torch.arange(4)},
        "model": {"weight": torch.rand(3)},
        "random": torch.get_rng_state(),
    }
    (folder / FOLDER).mkdir()
    torch.save(contents, folder / FOLDER / "7.pt")
    return [folder / FOLDER / "7.pt"]


def read_step(folder: Path, damaged: Path) -> None:
    step = load_step(folder, 7)
    assert len(step.batch) == len(step.batch.origins) == len(step.batch.mask)
    torch.set_rng_state(step.random)


def make_pixels(folder: Path) -> list[Path]:
    """The pixels of a capture in the cache of a run."""
    make_capture(folder / "capture", views=2)
    _load(folder)
    return sorted(path for path in (folder / "cache").rglob("*") if path.suffix in (".npy", ".json"))


def read_pixels(folder: Path, damaged: Path) -> None:
    """A damaged store is written again, except if only values of pixels are other ones."""
    before = damaged.stat().st_ino
    _load(folder)
    if damaged.stat().st_ino != before:
        raise UserError("the store was damaged", "nothing has to be done")


def _load(folder: Path) -> None:
    capture = _capture(folder / "capture")
    pixels = PixelDataset(capture, capture.views, folder=folder / "cache")
    for i, view in enumerate(capture.views):
        assert pixels.view(i).color.shape == (view.camera.width * view.camera.height, 3)


@cache
def _capture(folder: Path) -> Capture:
    return load_capture(folder)
