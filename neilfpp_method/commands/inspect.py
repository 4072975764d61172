"""`neilfpp inspect`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from neilfpp_method.commands.command import Command, terminal

__all__ = ["COMMAND"]


@dataclass
class Inspect:
    """Describe a capture and list the problems in it."""

    data: tyro.conf.Positional[Path]
    """The folder of the capture."""
    out: Path | None = None
    """Folder for inspect.json and inspect.png; default: they are not written."""
    format: str | None = None
    """Format of the capture; default: recognised from the files."""
    response: Literal["auto", "linear", "srgb"] = "auto"
    """What the pixels hold: linear radiance (HDR) or sRGB (LDR); auto: as the files say."""
    strict: bool = False
    """Exit with status 1 if there is a problem."""


def run(options: Inspect) -> None:
    from neilfpp_method.inspection.command import run_inspection

    run_inspection(options.data, options.out, options.format, options.response, options.strict, terminal())


COMMAND = Command(
    Inspect,
    run,
    ["neilfpp inspect captures/teapot", "neilfpp inspect captures/teapot --out teapot-inspection --strict"],
)
