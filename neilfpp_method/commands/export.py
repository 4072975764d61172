"""`neilfpp export`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from neilfpp_method.commands.command import Checkpoint, Command, Device, terminal

__all__ = ["COMMAND"]


@dataclass
class Export:
    """Write a run's surface and its light for other programs, in the capture's frame and scale."""

    run: tyro.conf.Positional[Path]
    """The run's folder."""
    what: tuple[Literal["mesh", "light"], ...] = ()
    """mesh: the surface (PLY). light: environment map (EXR), lamps (JSON), probes (EXR). None named: what the run has."""
    out: Path | None = None
    """The folder; none: RUN/export."""
    resolution: int = 256
    """Cells of the mesh along an edge of the scene's cube."""
    probes: int | None = None
    """Light probes, spread over the surface; none: 16 for a light that is free at every point, else 0."""
    checkpoint: Checkpoint = "last"
    """Which weights."""
    device: Device = "auto"
    """Where to compute."""


def run(options: Export) -> None:
    from neilfpp_method.export.command import run_export

    run_export(**vars(options), console=terminal())


COMMAND = Command(
    Export,
    run,
    ["neilfpp export runs/teapot --resolution 512", "neilfpp export runs/teapot --what light --probes 32 --out teapot"],
)
