"""Arrays that a run stores: the pixels of its capture, and skipped steps."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch

from neilfpp_method.data.pixels.dataset import PixelDataset
from neilfpp_method.errors import UserError
from neilfpp_method.schedule import Stage
from neilfpp_method.train.skipped import FOLDER, FORMAT, load_step
from tests.data.make_capture import make_capture
from tests.hard_cases.hostile.readers.reader import Reader, capture_beside

__all__ = ["STORED", "make_step"]


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


def _read_step(folder: Path, damaged: Path) -> None:
    step = load_step(folder, 7)
    assert len(step.batch) == len(step.batch.origins) == len(step.batch.mask)
    torch.set_rng_state(step.random)


def _make_pixels(folder: Path) -> list[Path]:
    """The pixels of a capture in the cache of a run."""
    make_capture(folder / "capture", views=2)
    _load(folder)
    return sorted(path for path in (folder / "cache").rglob("*") if path.suffix in (".npy", ".json"))


def _read_pixels(folder: Path, damaged: Path) -> None:
    """A damaged store is written again, except if only values of pixels are other ones."""
    before = damaged.stat().st_ino
    _load(folder)
    if damaged.stat().st_ino != before:
        raise UserError("the store was damaged", "nothing has to be done")


def _load(folder: Path) -> None:
    capture = capture_beside(folder / "capture")
    pixels = PixelDataset(capture, capture.views, folder=folder / "cache")
    for i, view in enumerate(capture.views):
        assert pixels.view(i).color.shape == (view.camera.width * view.camera.height, 3)


STORED: Mapping[str, Reader] = {
    "pixels in a run folder (NPY, JSON)": Reader(_make_pixels, _read_pixels, 0.2),
    "skipped step": Reader(make_step, _read_step),
}
