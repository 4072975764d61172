"""`neilfpp render`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from neilfpp_method.commands.command import Checkpoint, Command, Device, progress_bar, terminal
from neilfpp_method.errors import UserError

__all__ = ["COMMAND"]


@dataclass
class Render:
    """Render all maps of the views of a run as PNG and EXR, and the incident light at four points."""

    run: tyro.conf.Positional[Path]
    """The run folder."""
    out: Path | None = None
    """Output folder; default: RUN/renders."""
    what: tuple[Literal["maps", "light"], ...] = ("maps", "light")
    """maps: a folder of PNG files per map, and an EXR file per view. light: incident_light.png, next to the
    truth if it is known."""
    views: Literal["test", "train", "all"] = "test"
    """Views to render."""
    checkpoint: Checkpoint = "last"
    """Checkpoint to render."""
    overwrite: bool = False
    """Render pictures again that exist already."""
    confidence: bool = False
    """Add maps of the expected error of the material (base_color_std, …); takes about twice as long."""
    scale: float | None = None
    """Size of the views relative to their files; 1 for full size. Default: 131 thousand pixels per view,
    about 420×310, and at most the size of the training images.
    """
    width: int | None = None
    """Width of the views in pixels, instead of --scale."""
    device: Device = "auto"
    """Device to compute on."""


def run(options: Render) -> None:
    from neilfpp_method.evaluate.render_views import finished_views, render_run
    from neilfpp_method.evaluate.sheet import write_light_picture
    from neilfpp_method.evaluate.size import at_size, describe_size
    from neilfpp_method.kernels.process import computing_fast
    from neilfpp_method.train.device import pick_device
    from neilfpp_method.train.output import check_folder
    from neilfpp_method.train.run import load_run

    run = at_size(
        load_run(options.run, pick_device(options.device), options.checkpoint), options.scale, options.width
    )
    out = options.out or options.run / "renders"
    check_folder(out)
    if size := describe_size(run):
        terminal().print(size, soft_wrap=True)
    if "maps" in options.what:
        kept = [] if options.overwrite else finished_views(run, out, (options.views,), options.confidence)
        if kept:
            terminal().print(
                f"{len(kept)} of the views exist already and are kept, whatever checkpoint and size they "
                "have; --overwrite renders them again",
                soft_wrap=True,
            )
        with computing_fast(), progress_bar("rendering") as advance:
            render_run(run, out, (options.views,), options.overwrite, options.confidence, advance)
    if (
        "light" in options.what
        and not write_light_picture(run, out / "incident_light.png")
        and options.what == ("light",)
    ):
        raise UserError(f"{options.run}: the run has no light yet at step {run.step}", "train the next stage")
    terminal().print(f"written to {out}", soft_wrap=True)


COMMAND = Command(
    Render,
    run,
    [
        "neilfpp render runs/teapot",
        "neilfpp render runs/teapot --views all",
        "neilfpp render runs/teapot --what light",
    ],
)
