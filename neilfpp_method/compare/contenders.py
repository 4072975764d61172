"""The runs of a comparison, as their folders describe them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from neilfpp_method.data.capture import Capture
from neilfpp_method.errors import UserError
from neilfpp_method.report.files import Files, read_files
from neilfpp_method.train.run import CaptureSource, load_checkpoint, read_description

__all__ = ["Contender", "labels_of", "read_contenders"]

MAX_RUNS = 16
"""A table of more columns is for no screen, and a sheet of more pictures for no page."""


@dataclass(frozen=True)
class Contender:
    """A run of the comparison.

    Attributes:
        label: what tells it from the others, in few letters.
        path: its folder, as it was given.
        files: what lies there.
        source: how its capture is read.
        capture: the capture, its views at the size that the run was trained at.
        step: how many steps its last checkpoint has seen; 0: it has none.
    """

    label: str
    path: Path
    files: Files
    source: CaptureSource
    capture: Capture
    step: int

    @property
    def has_model(self) -> bool:
        """Whether there is something to render."""
        return self.step > 0


def read_contenders(paths: Sequence[Path]) -> list[Contender]:
    """The runs, in the order in which they were given.

    Raises:
        UserError: fewer than two runs or too many, one is given twice, a folder is no run, or a run's capture
            has moved.
    """
    if not 2 <= len(paths) <= MAX_RUNS:
        raise UserError(f"{len(paths)} runs to compare", f"give the folders of 2 to {MAX_RUNS} runs")
    resolved = [path.resolve() for path in paths]
    for i, path in enumerate(resolved):
        if path in resolved[:i]:
            raise UserError(f"{paths[i]}: given twice", "give every run once")
    described = [(path, read_files(path), read_description(path).source) for path in paths]
    return [
        Contender(label, path, files, source, source.load_again(path), _step(path))
        for label, (path, files, source) in zip(labels_of(resolved), described, strict=True)
    ]


def _step(path: Path) -> int:
    last = path / "checkpoints" / "last.pt"
    return int(load_checkpoint(last)["step"]) if last.is_file() else 0


def labels_of(paths: Sequence[Path]) -> list[str]:
    """The end of each path, as many folders of it as it takes to tell all apart.

    >>> labels_of([Path("/a/teapot/fast"), Path("/a/lamp/fast")])
    ['teapot/fast', 'lamp/fast']
    """
    for depth in range(1, max(len(path.parts) for path in paths)):
        labels = ["/".join(path.parts[-depth:]) for path in paths]
        if len(set(labels)) == len(labels):
            return labels
    return [str(path) for path in paths]
