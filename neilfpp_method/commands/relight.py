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
    """Render a run under other light by path tracing; writes RUN/relit/MAP/VIEW.exr and .png."""

    run: tyro.conf.Positional[Path]
    """The run folder."""
    env: tuple[Path, ...] = ()
    """Environment maps (EXR, HDR, PNG, JPEG), each rendered into a folder of its own; default: the light of
    the run."""
    env_layout: Literal["ours", "common"] = "ours"
    """ours: as `neilfpp export` writes maps. common: as Blender reads them, rotated by 90 degrees."""
    rotate: float = 0.0
    """Rotation of the map about +z in degrees, counter-clockwise seen from above."""
    exposure: float = 0.0
    """Exposure added to the map, in stops."""
    lamps: Literal["auto", "keep", "drop"] = "auto"
    """What to do with the lamps of the run; auto: keep them under its own light, drop them under another."""
    lamp_edits: Annotated[
        tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(name="lamp", metavar="NUMBER=X,Y,Z|off")
    ] = ()
    """Move a lamp of the run (0=1,0.5,2, in the capture's world frame) or switch it off (1=off), and keep the
    others; numbers as in lamps.json; repeatable."""
    views: Annotated[tuple[str, ...], tyro.conf.arg(metavar="test|train|all|turntable|VIEW [VIEW ...]")] = (
        "test",
    )
    """Views of the capture, as a set or by name; or a circle around the scene, which is also
    written as turntable.mp4."""
    frames: int | None = None
    """Number of frames of a turntable; default: 96."""
    edits: Annotated[
        tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(name="set", metavar="NAME=VALUE")
    ] = ()
    """Change the material: roughness=0.2, metallic=1 or base_color=0.8,0.1,0.1 (linear); repeatable."""
    box: tuple[float, float, float, float, float, float] | None = None
    """Restrict --set to this box: two corners, x y z x y z, in the capture's world frame."""
    mask: tuple[Path, ...] = ()
    """Restrict --set to the white pixels of these images; each is a mask of the view with the same name."""
    spp: int | None = None
    """Maximum number of samples per pixel; default: 64, or as many as --seconds permits."""
    seconds: float | None = None
    """Maximum time per view, in seconds."""
    bounces: int = 6
    """Maximum number of surfaces on a light path; 1 for direct light only."""
    scale: float | None = None
    """Size of the pictures relative to the views."""
    width: int | None = None
    """Width of the pictures in pixels; default, without --scale: that of the views, at most 800."""
    background: Literal["transparent", "map"] = "transparent"
    """Background of the pictures."""
    denoise: bool = False
    """Denoise the pictures (needs the extra `denoise`)."""
    truth: tuple[Path, ...] = ()
    """A folder of true images, VIEW.exr or .png, for each map; writes RUN/relit/MAP/metrics.json."""
    out: Path | None = None
    """Folder for the folders of the maps; default: RUN/relit."""
    resolution: int = 512
    """Cells of the traced mesh along an edge of the scene's cube, if the run has no mesh of its own; the mesh
    is kept in RUN/cache for the next command."""
    force: bool = False
    """Render pictures again that exist already."""
    checkpoint: Checkpoint = "last"
    """Checkpoint to render."""
    device: Device = "auto"
    """Device to compute on."""


def run(options: Relight) -> None:
    from neilfpp_method.kernels.process import computing_fast
    from neilfpp_method.relight.command import relight
    from neilfpp_method.relight.request import RelightRequest

    console = terminal()
    messages: list[str] = []
    with computing_fast(), progress_bar("relighting") as advance:
        out = relight(RelightRequest(**vars(options)), messages.append, advance)
    for line in (*messages, f"written to {out}"):
        console.print(line, soft_wrap=True)


COMMAND = Command(
    Relight,
    run,
    [
        "neilfpp relight runs/teapot --env studio.exr",
        "neilfpp relight runs/teapot --env forest.hdr --env-layout common --rotate 90 --views turntable",
        "neilfpp relight runs/teapot --set roughness=0.2 --set metallic=1 --mask 004.png --seconds 20",
        "neilfpp relight runs/lantern --lamp 0=0.5,-1,1.2 --lamp 1=off",
    ],
)
