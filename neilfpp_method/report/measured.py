"""Read the figures in a run's folder: those of `neilfpp eval`, and of published protocols in `eval/`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from neilfpp_method.errors import UserError
from neilfpp_method.train.checkpoint import last_checkpoint
from neilfpp_method.train.json_files import is_finite_number, read_json

__all__ = ["OWN", "Measured", "count_of_views", "finite_numbers", "is_outdated", "read_measured"]

OWN = "neilfpp"
"""The name of this project's own protocol."""


@dataclass(frozen=True)
class Measured:
    """Figures under one protocol.

    Attributes:
        protocol: the name that `neilfpp eval --protocol` takes.
        description: how the figures were measured, as texts by name.
        figures: figures by name.
        views: names of the measured views; None if the file does not contain them.
        size: width and height of the widest view, pixels; None if the file does not contain it.
        outdated: whether the figures are older than the checkpoint.
    """

    protocol: str
    description: Mapping[str, str]
    figures: Mapping[str, float]
    views: tuple[str, ...] | None
    size: tuple[int, int] | None
    outdated: bool

    @property
    def extent(self) -> str:
        """Number of views and their size for display; empty if they are not known."""
        if self.views is None or self.size is None:
            return ""
        return f"{count_of_views(len(self.views))} of {self.size[0]}×{self.size[1]} pixels"


def read_measured(path: Path, protocol: str) -> Measured | None:
    """Read the figures of a run under one protocol.

    Args:
        path: the folder of the run.
        protocol: `OWN`, or a name in `evaluate.published.PROTOCOLS`.

    Returns:
        The figures; None if the run was not measured by this protocol.

    Raises:
        UserError: the file is damaged, or a figure is not finite.
    """
    file = path / "metrics.json" if protocol == OWN else path / "eval" / f"{protocol}.json"
    if not file.is_file():
        return None
    measured = _own(file) if protocol == OWN else _published(protocol, file)
    return measured if measured.figures else None


def is_outdated(file: Path, run: Path) -> bool:
    """Whether a file of figures is older than the last checkpoint of its run."""
    checkpoint = last_checkpoint(run)
    return checkpoint.is_file() and file.stat().st_mtime < checkpoint.stat().st_mtime


def finite_numbers(file: Path, values: Mapping[str, Any]) -> dict[str, float]:
    """Keep the values of a file that are numbers; booleans, texts and lists are left out.

    Raises:
        UserError: a number is NaN, infinite, or too large for a float.
    """
    numbers = {k: v for k, v in values.items() if isinstance(v, int | float) and not isinstance(v, bool)}
    for key, value in numbers.items():
        if not is_finite_number(value):
            raise UserError(f"{file}: {key} is not a finite number", "restore the file, or remove it")
    return {key: float(value) for key, value in numbers.items()}


def count_of_views(count: int) -> str:
    """A number of views in words.

    >>> count_of_views(1), count_of_views(4)
    ('one view', '4 views')
    """
    return "one view" if count == 1 else f"{count} views"


def _own(file: Path) -> Measured:
    protocol_file = file.with_name(f"{file.stem}-protocol.json")
    protocol = read_json(protocol_file) if protocol_file.is_file() else {}
    description = {name: text for name, text in protocol.items() if isinstance(text, str)}
    return _measured(OWN, file, description, read_json(file), protocol.get("measured"))


def _published(name: str, file: Path) -> Measured:
    stored = read_json(file)
    description = {key: stored[key] for key in ("source", "left_out") if isinstance(stored.get(key), str)}
    figures = stored.get("figures")
    figures = figures if isinstance(figures, dict) else {}
    return _measured(name, file, description, figures, stored.get("measured"))


def _measured(
    name: str, file: Path, description: Mapping[str, str], figures: Mapping[str, Any], measured: Any
) -> Measured:
    measured = measured if isinstance(measured, dict) else {}
    views, size = measured.get("view_names"), (measured.get("width"), measured.get("height"))
    run = file.parent if name == OWN else file.parent.parent
    return Measured(
        protocol=name,
        description=description,
        figures=finite_numbers(file, figures),
        views=tuple(map(str, views)) if isinstance(views, list) and views else None,
        size=size if all(isinstance(side, int) for side in size) else None,
        outdated=is_outdated(file, run),
    )
