"""`neilfpp prepare`; its options are defined in `prepare.options`."""

from __future__ import annotations

from neilfpp_method.commands.command import Command, terminal
from neilfpp_method.prepare.options import Prepare

__all__ = ["COMMAND"]


def run(options: Prepare) -> None:
    from neilfpp_method.prepare.command import run_prepare

    run_prepare(options, terminal())


COMMAND = Command(
    Prepare,
    run,
    [
        "neilfpp prepare photos/teapot --out captures/teapot",
        "neilfpp prepare photos/teapot --out captures/teapot --also nerfstudio neilf",
        "neilfpp prepare scans/colmap-project --out captures/teapot   (keeps the poses)",
    ],
)
