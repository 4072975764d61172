"""`neilfpp eval`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro
from rich.console import Console

from neilfpp_method.commands.command import Checkpoint, Command, Device, progress_bar, terminal

__all__ = ["COMMAND"]


@dataclass
class Eval:
    """Evaluate a run on its test views; writes RUN/metrics.json or, with --protocol, RUN/eval/NAME.json."""

    run: tyro.conf.Positional[Path]
    """The run folder."""
    protocol: Literal[
        "neilfpp",
        "neilf-synthetic",
        "tensoir",
        "stanford-orb",
        "synthetic4relight",
        "dtu",
        "shiny-normals",
    ] = "neilfpp"
    """Evaluation protocol. neilfpp: the metrics of this project. Others: as in the official code of that
    benchmark, at the size of the image files (docs/protocols.md)."""
    checkpoint: Checkpoint = "last"
    """Checkpoint to evaluate."""
    out: Path | None = None
    """Output file; default: RUN/metrics.json, or RUN/eval/NAME.json for a published protocol."""
    scale: float | None = None
    """Size of the views relative to their files; 1 for full size. Default: 131 thousand pixels per view,
    about 420×310, and at most the size of the training images.
    """
    width: int | None = None
    """Width of the views in pixels, instead of --scale."""
    device: Device = "auto"
    """Device to compute on."""


def run(options: Eval) -> None:
    if options.protocol == "neilfpp":
        _own(options)
    else:
        _published(options)


def _published(options: Eval) -> None:
    from neilfpp_method.evaluate.published import PROTOCOLS
    from neilfpp_method.evaluate.published.protocol import write_figures
    from neilfpp_method.evaluate.size import at_size, describe_size
    from neilfpp_method.evaluate.views import render_test_views
    from neilfpp_method.kernels.process import computing_fast
    from neilfpp_method.train.device import pick_device
    from neilfpp_method.train.output import check_writable
    from neilfpp_method.train.run import load_run

    protocol = PROTOCOLS[options.protocol]
    scale, width = options.scale, options.width
    if scale is None and width is None:
        scale, width = (1.0, None) if protocol.side is None else (None, protocol.side)
    run = at_size(load_run(options.run, pick_device(options.device), options.checkpoint), scale, width)
    out = options.out or options.run / "eval" / f"{protocol.name}.json"
    check_writable(out)
    protocol.check(run)
    console = terminal()
    if protocol.side is None and (size := describe_size(run)):
        console.print(f"{size}; published figures are at the size of the files", soft_wrap=True)
    with computing_fast(), progress_bar("evaluating") as advance:
        figures = protocol.measure(run, render_test_views(run, advance) if protocol.needs_views else ())
        advance(1.0)
    write_figures(out, protocol, run, figures)
    console.print(
        f"protocol {protocol.name}, as {protocol.source}; not computed: {protocol.left_out}", soft_wrap=True
    )
    _print(figures, out, console)


def _own(options: Eval) -> None:
    from neilfpp_method.evaluate.protocols import evaluate, write_metrics
    from neilfpp_method.evaluate.size import at_size, describe_size
    from neilfpp_method.kernels.process import computing_fast
    from neilfpp_method.train.device import pick_device
    from neilfpp_method.train.output import check_writable
    from neilfpp_method.train.run import load_run

    run = at_size(
        load_run(options.run, pick_device(options.device), options.checkpoint), options.scale, options.width
    )
    out = options.out or options.run / "metrics.json"
    check_writable(out)
    console = terminal()
    if size := describe_size(run):
        console.print(size, soft_wrap=True)
    with computing_fast(), progress_bar("evaluating") as advance:
        metrics = evaluate(run, advance)
    write_metrics(out, run, metrics)
    _print(metrics, out, console)


def _print(figures: Mapping[str, float], out: Path, console: Console) -> None:
    for name, value in figures.items():
        console.print(f"{name:36} {value:8.3f}")
    console.print(f"written to {out}", soft_wrap=True)


COMMAND = Command(
    Eval,
    run,
    [
        "neilfpp eval runs/teapot",
        "neilfpp eval runs/teapot --checkpoint material_init --out sep.json",
        "neilfpp eval runs/teapot --protocol neilf-synthetic",
    ],
)
