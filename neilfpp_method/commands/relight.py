"""`neilfpp relight`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from neilfpp_method.commands.command import Checkpoint, Command, Device, progress_bar, terminal

__all__ = ["COMMAND"]


@dataclass
class Relight:
    """Show a run's scene under other light, by path tracing; writes RUN/relit/MAP/VIEW.exr and .png."""

    run: tyro.conf.Positional[Path]
    """The run's folder."""
    env: tuple[Path, ...] = ()
    """Environment maps (EXR, HDR, PNG, JPEG), a folder of pictures each; none: the run's own light."""
    env_layout: Literal["ours", "common"] = "ours"
    """ours: as `neilfpp export` writes maps. common: as Blender reads them, a quarter turn away."""
    rotate: float = 0.0
    """Degrees by which the map is turned about +z, counter-clockwise seen from above."""
    exposure: float = 0.0
    """Stops by which the map is made brighter."""
    lamps: Literal["auto", "keep", "drop"] = "auto"
    """The lamps that the run has found; auto: kept under its own light, left out under another."""
    lamp_edits: Annotated[
        tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(name="lamp", metavar="NUMBER=X,Y,Z|off")
    ] = ()
    """Move a lamp that the run has found, or leave it out, and keep the others: 0=1,0.5,2 (the capture's
    world) or 1=off; numbers as in lamps.json; can be given several times."""
    views: Annotated[tuple[str, ...], tyro.conf.arg(metavar="test|train|all|turntable|VIEW [VIEW ...]")] = (
        "test",
    )
    """Views of the capture, as a set or by name; or a circle about the scene, which also becomes
    turntable.mp4."""
    frames: int = 96
    """Pictures of a turntable."""
    edits: Annotated[
        tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(name="set", metavar="NAME=VALUE")
    ] = ()
    """Change the material: roughness=0.2, metallic=1 or base_color=0.8,0.1,0.1 (linear); repeatable."""
    box: tuple[float, float, float, float, float, float] | None = None
    """Change it in this box alone: two corners, x y z x y z, in the capture's world frame."""
    mask: tuple[Path, ...] = ()
    """Change it where these images are white: painted over a view each, and named as the view."""
    spp: int | None = None
    """Samples of a pixel at most; none: 64, or what --seconds allow."""
    seconds: float | None = None
    """Seconds for a view at most."""
    bounces: int = 6
    """Surfaces that light meets on its way at most; 1: direct light alone."""
    scale: float | None = None
    """Size of the pictures over that of the views."""
    width: int | None = None
    """Width of the pictures in pixels; with neither: that of the views, up to 800."""
    background: Literal["transparent", "map"] = "transparent"
    """What is where no surface is."""
    denoise: bool = False
    """Denoise the pictures (needs the extra `denoise`)."""
    truth: tuple[Path, ...] = ()
    """For each map a folder of true images, VIEW.exr or .png; writes RUN/relit/MAP/metrics.json."""
    out: Path | None = None
    """Where the folders of the maps go; none: RUN/relit."""
    resolution: int = 512
    """Cells of the traced mesh along an edge of the scene's cube, where the run has no mesh of its own."""
    force: bool = False
    """Render again what is there already."""
    checkpoint: Checkpoint = "last"
    """Which weights."""
    device: Device = "auto"
    """Where to compute."""


def run(options: Relight) -> None:
    from neilfpp_method.kernels.process import computing_fast
    from neilfpp_method.relight.command import Request, relight

    console = terminal()
    said: list[str] = []
    with computing_fast(), progress_bar("relighting") as advance:
        out = relight(Request(**vars(options)), said.append, advance)
    for line in (*said, f"written to {out}"):
        console.print(line, soft_wrap=True)


COMMAND = Command(
    Relight,
    run,
    [
        "neilfpp relight runs/teapot --env studio.exr",
        "neilfpp relight runs/teapot --env studio.exr --views 004 019 --spp 256",
        "neilfpp relight runs/teapot --env forest.hdr --env-layout common --rotate 90 --views turntable",
        "neilfpp relight runs/teapot --set roughness=0.2 --set metallic=1 --mask 004.png --seconds 20",
        "neilfpp relight runs/lantern --lamp 0=0.5,-1,1.2 --lamp 1=off",
    ],
)
