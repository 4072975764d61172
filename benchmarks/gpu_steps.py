"""Training steps on a GPU: time, number of kernels, and the time in which the GPU computes.

    python -m benchmarks.gpu_steps --presets fast paper-ngp --save gpu-steps
    python -m benchmarks.gpu_steps --presets fast --rays 4096

The scene is that of `benchmarks.steps`. If the GPU computes for a small part of a step, the rest is the
launching of its kernels, and more rays per step take hardly more time.
"""

from __future__ import annotations

import shlex
import sys
from dataclasses import dataclass

import torch
import tyro
from rich.console import Console
from torch.profiler import ProfilerActivity, profile

from benchmarks.command import run_benchmark
from benchmarks.measure import hardware, median_seconds, revision
from benchmarks.steps import model_of, pixels_of, step_of
from benchmarks.tables import RESULTS, Result, Row, markdown, write_result
from neilfpp_method.errors import UserError
from neilfpp_method.model import NeilfModel
from neilfpp_method.schedule import Stage
from neilfpp_method.settings.presets import preset

REPETITIONS = 20
PIXELS = 16_384
"""Number of pixels in the measurement of rendering."""


@dataclass
class Options:
    """Measure steps of presets on the GPU of this machine."""

    presets: tuple[str, ...] = ("fast", "paper-ngp", "paper-mlp")
    """Names of presets."""
    rays: int | None = None
    """Rays per step; default: those of the preset."""
    save: str | None = None
    """Name of a result file."""


def measured(model: NeilfModel, stage: Stage, rays: int) -> dict[str, float]:
    """Milliseconds, kernels, milliseconds of computation, and peak MiB of a step."""
    step = step_of(model, stage, rays)
    (seconds,) = median_seconds(step, repetitions=REPETITIONS)
    torch.cuda.reset_peak_memory_stats()
    with profile(activities=[ProfilerActivity.CUDA]) as profiled:
        step()
        torch.cuda.synchronize()
    kernels = [e for e in profiled.events() if e.device_type == torch.autograd.DeviceType.CUDA]
    return {
        "step_ms": 1e3 * seconds,
        "kernels": len(kernels),
        "computing_ms": sum(e.self_device_time_total for e in kernels) / 1e3,
        "peak_mib": torch.cuda.max_memory_allocated() / 2**20,
    }


def main(options: Options, console: Console) -> None:
    """Print the table, and write it into a result file if one is named."""
    if not torch.cuda.is_available():
        raise UserError("no GPU here", "use a machine with CUDA; `python -m benchmarks steps` needs none")
    rows = []
    for name in options.presets:
        rays = options.rays or preset(name).train.rays
        model = model_of(name)
        for stage in Stage:
            figures = measured(model, stage, rays)
            rows.append(Row(f"`{name}`, {rays} rays, {stage.value.replace('_', ' ')}", figures))
        model.eval()
        pixels = pixels_of(PIXELS).rays
        (seconds,) = median_seconds(lambda model=model, pixels=pixels: model.maps(pixels))
        console.print(f"{name}: {1e6 * seconds / PIXELS:.2f} µs per pixel with all maps", markup=False)
    command = f"python -m benchmarks.gpu_steps {shlex.join(sys.argv[1:])}".strip()
    result = Result("gpu-steps", revision(), command, hardware(), tuple(rows))
    console.print(markdown([result]), markup=False, highlight=False, soft_wrap=True)
    if options.save:
        write_result(RESULTS / f"{options.save}.json", result)


if __name__ == "__main__":
    run_benchmark(lambda: main(tyro.cli(Options), Console()))
