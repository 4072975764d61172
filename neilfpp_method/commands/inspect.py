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
    """Say what is in a capture and what is wrong with it."""

    data: tyro.conf.Positional[Path]
    """The capture's folder."""
    out: Path | None = None
    """Where inspect.json and inspect.png go; none: they are not written."""
    format: str | None = None
    """The capture's format; none: told from what is in the folder."""
    response: Literal["auto", "linear", "srgb"] = "auto"
    """What the pixels are: linear radiance (HDR) or sRGB (LDR); auto: told from the files."""
    strict: bool = False
    """End with status 1 where there is a problem."""


def run(options: Inspect) -> None:
    from neilfpp_method.inspection.command import run_inspection

    run_inspection(options.data, options.out, options.format, options.response, options.strict, terminal())


COMMAND = Command(
    Inspect,
    run,
    ["neilfpp inspect captures/teapot", "neilfpp inspect captures/teapot --out teapot-inspection --strict"],
)
