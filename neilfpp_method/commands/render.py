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
    """Write every map of a run's views as PNG and EXR, and a picture of the incident light at four points."""

    run: tyro.conf.Positional[Path]
    """The run's folder."""
    out: Path | None = None
    """Where the pictures go; none: RUN/renders."""
    what: tuple[Literal["maps", "light"], ...] = ("maps", "light")
    """maps: a folder each, and an EXR a view. light: incident_light.png, beside the truth where known."""
    views: Literal["test", "train", "all"] = "test"
    """Which views."""
    checkpoint: Checkpoint = "last"
    """Which weights."""
    overwrite: bool = False
    """Render again what is there already."""
    confidence: bool = False
    """Add maps of the expected error of the material (base_color_std, …); takes about twice as long."""
    scale: float | None = None
    """Size of the views over that of their files; 1: every pixel. None: 131 thousand pixels a view, about
    420×310, and no more than the run was trained at.
    """
    width: int | None = None
    """Width of the views in pixels, in place of --scale."""
    device: Device = "auto"
    """Where to compute."""


def run(options: Render) -> None:
    from neilfpp_method.evaluate.render_views import render_run
    from neilfpp_method.evaluate.sheet import write_light_picture
    from neilfpp_method.evaluate.size import at_size, size_in_words
    from neilfpp_method.kernels.process import computing_fast
    from neilfpp_method.train.device import pick_device
    from neilfpp_method.train.run import check_folder, load_run

    run = at_size(
        load_run(options.run, pick_device(options.device), options.checkpoint), options.scale, options.width
    )
    out = options.out or options.run / "renders"
    check_folder(out)
    if size := size_in_words(run):
        terminal().print(size, soft_wrap=True)
    if "maps" in options.what:
        with computing_fast(), progress_bar("rendering") as advance:
            render_run(run, out, options.views, options.overwrite, options.confidence, advance)
    if (
        "light" in options.what
        and not write_light_picture(run, out / "incident_light.png")
        and options.what == ("light",)
    ):
        raise UserError(
            f"{options.run}: there is no light to show at step {run.step}", "train the next stage"
        )
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
