"""The interface of a published protocol, and what several protocols share."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from neilfpp_method.data.capture import Capture
from neilfpp_method.data.files.json_entry import write_json
from neilfpp_method.data.views import View
from neilfpp_method.errors import UserError
from neilfpp_method.evaluate.size import measured_views
from neilfpp_method.evaluate.views import RenderedView
from neilfpp_method.train.run import Run

__all__ = ["Protocol", "missing", "no_surface", "write_figures"]


@dataclass(frozen=True)
class Protocol:
    """A published protocol.

    Attributes:
        name: the name that `neilfpp eval --protocol` takes.
        source: repository and file of the official code.
        left_out: figures that the official code reports and this implementation does not, with the reason.
        check: raises a `UserError` if the run or its capture lacks what the protocol needs; called before
            views are rendered.
        measure: computes figures by name from the rendered test views, in order.
        needs_views: whether the test views must be rendered; if False, `measure` gets an empty sequence.
        side: width at which views are rendered, pixels; None for the width of their files.
    """

    name: str
    source: str
    left_out: str
    check: Callable[[Run], None]
    measure: Callable[[Run, Sequence[RenderedView]], dict[str, float]]
    needs_views: bool = True
    side: int | None = None


def missing(protocol: str, capture: Capture, view: View, what: str, place: str) -> UserError:
    """The error for a test view that lacks a file which the protocol needs.

    Args:
        protocol: name of the protocol.
        capture: the capture.
        view: the test view.
        what: what is missing.
        place: the path, relative to the capture, at which it is expected.
    """
    return UserError(
        f"{capture.root}: the protocol {protocol} needs {what} of every test view; view {view.name} has none",
        f"put it at {place}",
    )


def no_surface(run: Run) -> UserError:
    """The error for a run of which no test view shows a surface."""
    return UserError(f"{run.path}: no test view shows a surface", "train longer, or check the run's report")


def write_figures(path: Path, protocol: Protocol, run: Run, figures: Mapping[str, float]) -> None:
    """Write the figures of one protocol as JSON, with its name, its source, and the views measured."""
    described = {"protocol": protocol.name, "source": protocol.source, "left_out": protocol.left_out}
    write_json(path, {**described, "measured": measured_views(run), "figures": dict(figures)})
