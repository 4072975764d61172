"""`neilfpp tradeoff`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from neilfpp_method.commands.command import Command, terminal
from neilfpp_method.commands.report import after_training

__all__ = ["COMMAND"]


@dataclass
class Tradeoff:
    """Measure accuracy against training time: train with several time budgets and plot the frontier."""

    data: Path
    """The folder of the capture."""
    budgets: str = "1m,3m,10m"
    """Time budgets of the runs, such as 90s, 10m or 1h, separated by commas."""
    out: Path | None = None
    """Folder for the runs and for tradeoff.csv, .json and .svg; default: runs/CAPTURE-PRESET-tradeoff.
    Finished runs in it are used again, and stopped ones are continued.
    """
    seeds: int = 1
    """Number of runs per budget with different seeds; with two or more the figure has error bars."""
    preset: Literal["fast", "balanced", "best", "paper-mlp", "paper-ngp", "paper-ngp-hdr"] = "fast"
    """Preset of all runs."""
    host: Literal["volsdf", "mesh"] = "volsdf"
    """Source of geometry, as in neilfpp train; mesh: the capture's inputs/model/mesh.ply."""
    report: bool = False
    """Write the report of each run, within its budget."""
    relight: Path | None = None
    """Also relight the test views of each run with this environment map, and compare with --truth."""
    truth: Path | None = None
    """Folder of the true images of the test views under the map of --relight: VIEW.exr or .png."""
    env_layout: Literal["ours", "common"] = "ours"
    """Layout of the map of --relight, as in neilfpp relight."""
    device: Annotated[str, tyro.conf.arg(metavar="cpu|cuda|cuda:N|auto|cuda:N,cuda:N")] = "auto"
    """Device to compute on, or several: then each has one run at a time, in a process of its own."""
    slurm: Annotated[str | None, tyro.conf.arg(metavar="NAME=VALUE,NAME=VALUE")] = None
    """Make each run a job of a Slurm cluster with these parameters of submitit and sbatch, such as
    partition=gpu,gpus_per_node=1. Several devices and --slurm need the extra `cluster`.
    """


def run(options: Tradeoff) -> None:
    from neilfpp_method.budget.durations import read_duration
    from neilfpp_method.kernels.process import computing_fast
    from neilfpp_method.settings.presets import fixed_geometry, preset
    from neilfpp_method.tradeoff.command import run_tradeoff
    from neilfpp_method.tradeoff.planned_runs import TradeoffRequest

    config = preset(options.preset)
    config = fixed_geometry(config) if options.host == "mesh" else config
    budgets = [read_duration(word) for word in options.budgets.split(",") if word.strip()]
    out = options.out or Path("runs") / f"{options.data.resolve().name}-{config.preset}-tradeoff"
    request = TradeoffRequest(
        data=options.data,
        out=out,
        config=config,
        budgets=budgets,
        seeds=options.seeds,
        device=options.device,
        slurm=options.slurm,
        relight=options.relight,
        truth=options.truth,
        env_layout=options.env_layout,
    )
    with computing_fast():
        run_tradeoff(request, terminal(), after_training if options.report else None)


COMMAND = Command(
    Tradeoff,
    run,
    [
        "neilfpp tradeoff --data captures/teapot --budgets 1m,3m,10m",
        "neilfpp tradeoff --data captures/teapot --host mesh --budgets 1m,3m --seeds 3 --out runs/frontier",
        "neilfpp tradeoff --data captures/teapot --relight studio.exr --truth captures/teapot_studio",
        "neilfpp tradeoff --data captures/teapot --seeds 3 --device cuda:0,cuda:1",
        "neilfpp tradeoff --data captures/teapot --seeds 3 --slurm partition=gpu,gpus_per_node=1",
    ],
)
