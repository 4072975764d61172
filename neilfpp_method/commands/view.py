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
    """Show a run in the browser: its maps, its light, and its scene under other light."""

    run: tyro.conf.Positional[Path]
    """The run folder."""
    env: tuple[Path, ...] = ()
    """Environment maps (EXR, HDR, PNG, JPEG), or folders of them, to offer in addition to the run's light."""
    env_layout: Literal["ours", "common"] = "ours"
    """ours: as `neilfpp export` writes maps. common: as Blender reads them."""
    follow: bool = False
    """Follow a run in training, and show every new checkpoint."""
    host: str = "127.0.0.1"
    """Address to listen on. 127.0.0.1: only this machine; 0.0.0.0: all machines that can reach this one."""
    port: int = 8080
    """Port to listen on."""
    resolution: int = 256
    """Cells along an edge of the scene's cube, if the surface comes from a distance field."""
    checkpoint: Checkpoint = "last"
    """Checkpoint to show."""
    device: Device = "auto"
    """Device to compute on."""


def run(options: View) -> None:
    from neilfpp_method.kernels.process import computing_fast
    from neilfpp_method.view.command import ViewRequest, view

    with computing_fast():
        view(ViewRequest(**vars(options)), lambda text: terminal().print(text, soft_wrap=True))


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
