"""Training says what shows the object, and whether the masks look inverted."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from rich.console import Console

from neilfpp_method.data.files.images import write_png
from neilfpp_method.train import command
from neilfpp_method.train.request import TrainingRequest
from tests.data.make_capture import make_capture
from tests.train.small_runs import small_config


def said_by_training(monkeypatch, root: Path, out: Path) -> list[str]:
    """The lines that a training prints before its first step; the loop is left out."""
    monkeypatch.setattr(command, "train", lambda training: None)
    console = Console(file=io.StringIO(), width=200)
    request = TrainingRequest(root, out, small_config(), test_every=0, device="cpu")
    command.run_training(request, console)
    return console.file.getvalue().splitlines()


def with_alpha(root: Path, views: slice) -> Path:
    """Move the masks of some views into the alpha channel of their images, and remove the others."""
    for path in sorted((root / "inputs" / "masks").iterdir())[views]:
        image = Image.open(root / "inputs" / "images" / path.name).convert("RGB")
        image.putalpha(Image.open(path).convert("L"))
        image.save(root / "inputs" / "images" / path.name)
    for path in (root / "inputs" / "masks").iterdir():
        path.unlink()
    return root


@pytest.mark.parametrize(
    ("views", "line"),
    [
        (slice(None), "object: shown by the alpha channel"),
        (slice(4), "object: shown by the alpha channel in 4 of 6 views"),
        (slice(0), "object: shown by the background of one colour"),
    ],
)
def test_what_shows_the_object(tmp_path, monkeypatch, views, line):
    root = with_alpha(make_capture(tmp_path / "capture", hdr=False, masks=True, background=0.2), views)
    said = said_by_training(monkeypatch, root, tmp_path / "run")
    assert line in said
    assert not any("look inverted" in line for line in said)


def test_a_scene_that_fills_the_images(tmp_path, monkeypatch):
    root = make_capture(tmp_path / "capture", hdr=False)
    for path in sorted((root / "inputs" / "images").iterdir()):
        write_png(path, np.random.default_rng(0).integers(1, 255, (18, 24, 3), dtype=np.uint8))
    said = said_by_training(monkeypatch, root, tmp_path / "run")
    assert "object: no mask, alpha channel or background of one colour shows it; all pixels count" in said


@pytest.mark.parametrize("alpha", [False, True])
def test_inverted_masks(tmp_path, monkeypatch, alpha):
    root = make_capture(tmp_path / "capture", hdr=False, masks=True, background=0.2)
    for path in (root / "inputs" / "masks").iterdir():
        write_png(path, 255 - np.asarray(Image.open(path)))
    if alpha:
        with_alpha(root, slice(None))
    said = said_by_training(monkeypatch, root, tmp_path / "run")
    assert f"object: shown by the {'alpha channel' if alpha else 'mask file'}" in said
    assert any(line.startswith("problem: the masks look inverted") for line in said)
