"""`neilfpp report`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from neilfpp_method.commands.command import Command, Device, progress_bar, terminal

__all__ = ["COMMAND", "after_training"]

TELLING = 0.1
"""Share of the work done before the total time is estimated: loading and compiling come first."""


@dataclass
class Report:
    """Write a page that shows a run: its views beside the truth, its surface in 3-D, light, figures."""

    run: tyro.conf.Positional[Path]
    """The run's folder."""
    out: Path | None = None
    """The page; none: RUN/report.html."""
    views: int = 2
    """How many views are rendered for it."""
    size: int = 320
    """Pixels of the longest side of its pictures."""
    confidence: bool = False
    """Add how far off base colour, roughness and metallic may be; takes about twice as long."""
    device: Device = "auto"
    """Where to render."""


def run(options: Report) -> None:
    from neilfpp_method.kernels.process import computing_fast
    from neilfpp_method.report.write import REPORT, ReportOptions, write_report
    from neilfpp_method.train.device import pick_device
    from neilfpp_method.train.run import check_writable

    chosen = ReportOptions(options.views, options.size, options.confidence)
    chosen.check()
    out = options.out or options.run / REPORT
    check_writable(out)
    with computing_fast(), progress_bar("report") as advance:
        write_report(
            options.run,
            out,
            chosen,
            str(pick_device(options.device)),
            lambda share: advance(share) if share >= TELLING else None,
        )
    terminal().print(f"written to {out}", soft_wrap=True)


def after_training(path: Path, device: str) -> None:
    """The page of a run that has just ended; a page that cannot be made takes nothing from the run."""
    from neilfpp_method.errors import UserError

    try:
        run(Report(path, device=device))
    except UserError as error:
        terminal().print(
            f"no report: {error}; neilfpp report {path} tries again", style="yellow", soft_wrap=True
        )


COMMAND = Command(
    Report,
    run,
    ["neilfpp report runs/teapot", "neilfpp report runs/teapot --views 4 --size 800 --confidence"],
)
