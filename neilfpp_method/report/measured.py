"""Figures that lie in a run's folder: those of `neilfpp eval`, and of published protocols in `eval/`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from neilfpp_method.errors import UserError
from neilfpp_method.evaluate.published import PROTOCOLS
from neilfpp_method.train.run import read_json

__all__ = ["OWN", "Measured", "numbers", "read_measured"]

OWN = "neilfpp"
"""The name of this project's own protocol."""


@dataclass(frozen=True)
class Measured:
    """Figures under one protocol.

    Attributes:
        protocol: its name, as `neilfpp eval --protocol` has it.
        said: what else is to be known of them, in words, by name.
        figures: by name.
        views: the names of the views that were measured; none: the file does not say.
        size: width and height of the widest of them, pixels.
        outdated: whether the figures are older than the checkpoint.
    """

    protocol: str
    said: Mapping[str, str]
    figures: Mapping[str, float]
    views: tuple[str, ...] | None
    size: tuple[int, int] | None
    outdated: bool

    @property
    def extent(self) -> str:
        """The views and their size, in words; empty where that is not known."""
        if self.views is None or self.size is None:
            return ""
        many = f"{len(self.views)} views" if len(self.views) != 1 else "one view"
        return f"{many} of {self.size[0]}×{self.size[1]} pixels"


def read_measured(path: Path) -> tuple[dict[str, Measured], list[str]]:
    """The figures of a run by protocol, this project's own first, and a note on each file that is damaged.

    A protocol that was not measured is not there, and neither is one that this version does not know.
    """
    found: dict[str, Measured] = {}
    notes: list[str] = []
    for name in (OWN, *PROTOCOLS):
        file = path / "metrics.json" if name == OWN else path / "eval" / f"{name}.json"
        if not file.is_file():
            continue
        try:
            measured = _own(file) if name == OWN else _published(name, file)
        except UserError as error:
            notes.append(str(error))
            continue
        found |= {name: measured} if measured.figures else {}
    return found, notes


def numbers(values: Mapping[str, Any]) -> dict[str, float]:
    """The numbers among values, truth values left out."""
    return {
        key: float(v) for key, v in values.items() if isinstance(v, int | float) and not isinstance(v, bool)
    }


def _own(file: Path) -> Measured:
    beside = file.with_name(f"{file.stem}-protocol.json")
    described = read_json(beside) if beside.is_file() else {}
    said = {name: text for name, text in described.items() if isinstance(text, str)}
    return _measured(OWN, file, said, read_json(file), described.get("measured"))


def _published(name: str, file: Path) -> Measured:
    stored = read_json(file)
    said = {key: stored[key] for key in ("source", "left_out") if isinstance(stored.get(key), str)}
    figures = stored.get("figures")
    return _measured(name, file, said, figures if isinstance(figures, dict) else {}, stored.get("measured"))


def _measured(
    name: str, file: Path, said: Mapping[str, str], figures: Mapping[str, Any], what: Any
) -> Measured:
    what = what if isinstance(what, dict) else {}
    views, size = what.get("view_names"), (what.get("width"), what.get("height"))
    checkpoint = file.parent / ("" if name == OWN else "..") / "checkpoints" / "last.pt"
    return Measured(
        protocol=name,
        said=said,
        figures=numbers(figures),
        views=tuple(map(str, views)) if isinstance(views, list) and views else None,
        size=size if all(isinstance(side, int) for side in size) else None,
        outdated=checkpoint.is_file() and file.stat().st_mtime < checkpoint.stat().st_mtime,
    )
