"""Read the runs of a comparison from their folders."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from neilfpp_method.data.capture import Capture
from neilfpp_method.errors import UserError
from neilfpp_method.report.files import RunFiles, read_files
from neilfpp_method.train.checkpoint import last_checkpoint, load_checkpoint
from neilfpp_method.train.run import CaptureSource, read_description

__all__ = ["ComparedRun", "labels_of", "read_compared_runs"]

MAX_RUNS = 16
"""Largest number of runs. A table or image with more columns would not fit on a screen."""


@dataclass(frozen=True)
class ComparedRun:
    """A run of the comparison.

    Attributes:
        label: a short name that is unique among the runs.
        path: the run's folder, as given by the user.
        files: contents of the files there.
        source: how the run's capture is read.
        capture: the capture, with views of the size that the run was trained at.
        step: training step of the last checkpoint; 0 if there is none.
    """

    label: str
    path: Path
    files: RunFiles
    source: CaptureSource
    capture: Capture
    step: int

    @property
    def has_model(self) -> bool:
        """Whether the run has a checkpoint, so that it can be rendered."""
        return self.step > 0


def read_compared_runs(paths: Sequence[Path]) -> list[ComparedRun]:
    """Read the runs, in the order given.

    Raises:
        UserError: there are fewer than two runs or more than `MAX_RUNS`, one is given twice, a folder is not
            a run, or a run's capture was moved.
    """
    if not 2 <= len(paths) <= MAX_RUNS:
        raise UserError(f"runs to compare: {len(paths)}", f"give the folders of 2 to {MAX_RUNS} runs")
    resolved = [path.resolve() for path in paths]
    for i, path in enumerate(resolved):
        if path in resolved[:i]:
            raise UserError(f"{paths[i]}: given twice", "give every run once")
    # All folders are read before any capture is loaded, so that a folder that is not a run fails early.
    contents = [(path, read_files(path), read_description(path).source) for path in paths]
    return [
        ComparedRun(label, path, files, source, source.load_again(path), _last_step(path))
        for label, (path, files, source) in zip(labels_of(resolved), contents, strict=True)
    ]


def _last_step(path: Path) -> int:
    last = last_checkpoint(path)
    return int(load_checkpoint(last)["step"]) if last.is_file() else 0


def labels_of(paths: Sequence[Path]) -> list[str]:
    """Shorten paths to their last folders, as many as needed to make them unique.

    >>> labels_of([Path("/a/teapot/fast"), Path("/a/lamp/fast")])
    ['teapot/fast', 'lamp/fast']
    """
    for depth in range(1, max(len(path.parts) for path in paths)):
        labels = ["/".join(path.parts[-depth:]) for path in paths]
        if len(set(labels)) == len(labels):
            return labels
    return [str(path) for path in paths]
