"""`neilfpp report`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from neilfpp_method.commands.command import Command, Device, progress_bar, terminal

__all__ = ["COMMAND", "after_training"]

MIN_DONE_SHARE = 0.1
"""Share of the work after which the total time is estimated. Before, loading and compiling dominate."""


@dataclass
class Report:
    """Write an HTML page on a run: views next to the truth, the surface in 3-D, light, metrics."""

    run: tyro.conf.Positional[Path]
    """The run folder."""
    out: Path | None = None
    """Output file; default: RUN/report.html."""
    views: int = 2
    """Number of views to render."""
    size: int = 320
    """Longest side of a picture in pixels."""
    confidence: bool = False
    """Add the expected error of base colour, roughness and metallic; takes about twice as long."""
    device: Device = "auto"
    """Device to render on."""


def run(options: Report) -> None:
    from neilfpp_method.kernels.process import computing_fast
    from neilfpp_method.report.write import REPORT, ReportOptions, write_report
    from neilfpp_method.train.device import pick_device
    from neilfpp_method.train.output import check_page
    from neilfpp_method.train.run import read_description

    read_description(options.run)
    contents = ReportOptions(options.views, options.size, options.confidence)
    contents.check()
    out = options.out or options.run / REPORT
    check_page(out)
    messages: list[str] = []
    with computing_fast(), progress_bar("report") as advance:
        write_report(
            options.run,
            out,
            contents,
            str(pick_device(options.device)),
            lambda share: advance(share) if share >= MIN_DONE_SHARE else None,
            messages.append,
        )
    for line in (*messages, f"written to {out}"):
        terminal().print(line, soft_wrap=True)


def after_training(path: Path, device: str) -> None:
    """Write the report of a finished training. If that fails, print a warning; the run itself is complete."""
    from neilfpp_method.errors import UserError

    try:
        run(Report(path, device=device))
    except UserError as error:
        terminal().print(
            f"no report written: {error}; try again with: neilfpp report {path}",
            style="yellow",
            soft_wrap=True,
        )


COMMAND = Command(
    Report,
    run,
    ["neilfpp report runs/teapot", "neilfpp report runs/teapot --views 4 --size 800 --confidence"],
)
