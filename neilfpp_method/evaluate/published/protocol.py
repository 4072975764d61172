"""What a published protocol is, what it is given, and how it says that a capture lacks something."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from neilfpp_method.data.capture import Capture
from neilfpp_method.data.views import View
from neilfpp_method.errors import UserError
from neilfpp_method.evaluate.size import what_is_measured
from neilfpp_method.evaluate.views import RenderedView
from neilfpp_method.train.run import Run, write_json

__all__ = ["Protocol", "decibels", "missing", "write_figures"]

PERFECT = 1e-10
"""Least mean squared error: a perfect estimate is 100 dB here, infinite (not JSON) in official code."""


@dataclass(frozen=True)
class Protocol:
    """A published protocol.

    Attributes:
        name: as `neilfpp eval --protocol` has it.
        source: repository and file of the official code.
        left_out: what the official code reports and this does not, with the reason.
        check: raises a `UserError` where the capture lacks what the protocol needs; called before views are
            rendered.
        measure: figures by name, from the test views in order.
        needs_views: whether views are rendered for it; if not, `measure` is given none.
        side: width in pixels at which views are rendered; none: that of their files.
    """

    name: str
    source: str
    left_out: str
    check: Callable[[Run], None]
    measure: Callable[[Run, Sequence[RenderedView]], dict[str, float]]
    needs_views: bool = True
    side: int | None = None


def decibels(squared_error: float) -> float:
    """PSNR of a mean squared error, peak 1; at most 100."""
    return float(-10.0 * np.log10(max(squared_error, PERFECT)))


def missing(protocol: str, capture: Capture, view: View, what: str, place: str) -> UserError:
    """The error that says what a protocol needs of a view, and where it was looked for."""
    return UserError(
        f"{capture.root}: the protocol {protocol} needs {what} of every test view; view {view.name} has none",
        f"put it at {place}",
    )


def write_figures(path: Path, protocol: Protocol, run: Run, figures: Mapping[str, float]) -> None:
    """Write the figures of one protocol, with its name, its source, and what was measured."""
    described = {"protocol": protocol.name, "source": protocol.source, "left_out": protocol.left_out}
    write_json(path, {**described, "measured": what_is_measured(run), "figures": dict(figures)})
