"""`neilfpp view`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from neilfpp_method.commands.command import Checkpoint, Command, Device, terminal

__all__ = ["COMMAND"]


@dataclass
class View:
    """Look at a run in the browser: its layers, its light, other light."""

    run: tyro.conf.Positional[Path]
    """The run's folder."""
    env: tuple[Path, ...] = ()
    """Environment maps to choose from beside the run's own light (EXR, HDR, PNG, JPEG), or folders."""
    env_layout: Literal["ours", "common"] = "ours"
    """ours: as `neilfpp export` writes maps. common: as Blender reads them."""
    follow: bool = False
    """Wait for a run that trains, and show every new checkpoint."""
    host: str = "127.0.0.1"
    """Address to listen on. 127.0.0.1: this machine alone; 0.0.0.0: everybody who can reach it."""
    port: int = 8080
    """The port that is listened on."""
    resolution: int = 256
    """Cells along an edge of the scene, where the surface is taken from a distance field."""
    checkpoint: Checkpoint = "last"
    """Which weights."""
    device: Device = "auto"
    """Where to compute."""


def run(options: View) -> None:
    from neilfpp_method.kernels.process import computing_fast
    from neilfpp_method.view.command import Request, view

    with computing_fast():
        view(Request(**vars(options)), lambda text: terminal().print(text, soft_wrap=True))


COMMAND = Command(
    View,
    run,
    [
        "neilfpp view runs/teapot",
        "neilfpp view runs/teapot --env maps/ --env-layout common",
        "neilfpp view runs/teapot --follow   (while it trains)",
        "neilfpp view runs/teapot --port 9000",
    ],
)
