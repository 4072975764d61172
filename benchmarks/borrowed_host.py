"""Compare a plain function with the true surface, borrowed by `attach_neilf`, with `--host mesh`.

    python -m benchmarks.borrowed_host DATA/tabletop_env --save borrowed-host

Both have the true surface. The mesh host traces rays between surfaces itself and learns its own R. The
function returns the position, the normal and the mean radiance of the training views for camera rays; a proxy
traces rays between surfaces (`hosts.proxy`). Settings, seed, and the number of steps with a material are the
same.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from jaxtyping import Float, Int
from rich.console import Console
from torch import Tensor

from benchmarks.command import run_benchmark
from benchmarks.measure import hardware, revision
from benchmarks.tables import RESULTS, Result, Row, markdown, write_result
from neilfpp_method.attach import AttachedNeilf, attach_neilf
from neilfpp_method.data.capture import Capture, load_capture
from neilfpp_method.data.pixels.dataset import PixelDataset
from neilfpp_method.data.truth import Truth
from neilfpp_method.errors import UserError
from neilfpp_method.evaluate.protocols import evaluate
from neilfpp_method.evaluate.size import at_size
from neilfpp_method.hosts.mesh import MeshHost
from neilfpp_method.schedule import stage_at
from neilfpp_method.settings.presets import fixed_geometry, preset
from neilfpp_method.settings.types import NeilfConfig
from neilfpp_method.structures import RayBatch
from neilfpp_method.train.build import build_model, scene_facts
from neilfpp_method.train.checkpoint import last_checkpoint
from neilfpp_method.train.command import run_training
from neilfpp_method.train.optimizer import Stream, adam, seed_step, seed_stream, set_rates
from neilfpp_method.train.request import TrainingRequest
from neilfpp_method.train.run import Run, load_run

TABLE = "borrowed-host"
CELLS = 160
"""Cells along an edge of the function's grid of colours; a cell is about as wide as a pixel of the
capture.
"""
REACH = 1.6
"""Half the edge of that grid's cube, scene units; the table extends beyond the unit sphere."""
AT_ONCE = 65_536
"""Number of pixels per batch; bounds the memory."""


@dataclass
class Options:
    """Compare a borrowed plain function with the mesh host."""

    capture: tyro.conf.Positional[Path]
    """A capture with a true mesh and true materials."""
    out: Path = Path("runs/borrowed-host")
    """Folder of the run on the mesh."""
    steps: int = 1500
    """Number of steps with a material, for both."""
    scale: float = 1.0
    """Size of the test views relative to their files."""
    save: str | None = None
    """Name of the result file in benchmarks/results; default: the figures are only printed."""


class TrueSurface:
    """The function: hits of rays on a mesh, the normals there, and the mean colour of the training views near
    the hits.
    """

    def __init__(self, mesh: MeshHost, pixels: PixelDataset) -> None:
        self.mesh = mesh
        total = torch.zeros(CELLS**3, 3)
        count = torch.zeros(CELLS**3, 1)
        for i in range(len(pixels.views)):
            view = pixels.view(i, gradients=False)
            for start in range(0, len(view), AT_ONCE):
                part = view[start : start + AT_ONCE]
                met = mesh.intersect(part.rays)
                cell = self._cell(met.position)
                total.index_add_(0, cell, part.color[met.rows])
                count.index_add_(0, cell, torch.ones(len(cell), 1))
        self.color = total / count.clamp_min(1.0)

    @torch.no_grad()
    def __call__(
        self, origins: Float[Tensor, "N 3"], directions: Float[Tensor, "N 3"]
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Colour, position and normal of rays; zero normals where they miss."""
        met = self.mesh.intersect(RayBatch(origins, directions))
        outside = met.outside[:, None]
        nothing = torch.zeros_like(origins)
        return (
            nothing.index_put((met.rows,), self.color[self._cell(met.position)] * outside),
            origins.index_put((met.rows,), met.position),
            nothing.index_put((met.rows,), met.normal * outside),
        )

    def _cell(self, x: Float[Tensor, "N 3"]) -> Int[Tensor, " N"]:
        i, j, k = (CELLS * (x + REACH) / (2 * REACH)).long().clamp(0, CELLS - 1).unbind(-1)
        return (k * CELLS + j) * CELLS + i


def borrow(capture: Capture, pixels: PixelDataset, config: NeilfConfig, path: Path) -> Run:
    """Train material and light on the function, in a training loop like that of a user."""
    facts = scene_facts(capture, pixels, config)
    mesh = build_model(capture, facts, config).host
    seed_stream(config.train.seed, Stream.WEIGHTS)
    neilf: AttachedNeilf = attach_neilf(
        TrueSurface(mesh, pixels),
        config,
        response=facts.response,
        median_radiance=facts.median_radiance,
        radiance_scale=facts.radiance_scale,
        open_scene=facts.background == "inverted_sphere",
    )
    optimizer = adam(neilf.param_groups())
    steps = config.train.material_steps
    for step in range(steps):
        seed_step(config.train.seed, step)
        set_rates(optimizer, config.optimizer, stage_at(step, config.train))
        loss = neilf.losses(pixels.sample(config.train.rays, gradients=False), step).loss
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        if step % 100 == 0:
            print(f"step {step}: {loss.item():.4f}; {neilf.proxy.report()}", flush=True)
    return Run(path, config, capture, facts, neilf.model.eval(), steps)


def main(options: Options) -> None:
    """Train both, measure both, and print or keep the rows."""
    capture = load_capture(options.capture)
    if Truth(capture).mesh() is None:
        raise UserError(f"{options.capture}: no true mesh", "give a capture with inputs/model/mesh.ply")
    given = fixed_geometry(preset("fast"))
    given = dataclasses.replace(given, train=dataclasses.replace(given.train, material_steps=options.steps))
    on_mesh = options.out / options.capture.resolve().name
    begun = last_checkpoint(on_mesh).exists()
    request = TrainingRequest(
        data=None if begun else options.capture,
        out=on_mesh,
        config=None if begun else given,
        resume=begun,
        device="cpu",
    )
    # A finished run is not changed.
    run_training(request, Console())
    pixels = PixelDataset(capture, capture.train_views)
    borrowed = dataclasses.replace(given, train=dataclasses.replace(given.train, sdf_steps=0))
    runs = {
        "`--host mesh`": load_run(on_mesh),
        "the true surface as a plain function, borrowed": borrow(capture, pixels, borrowed, options.out),
    }
    name = options.capture.resolve().name
    rows = tuple(Row(label, evaluate(at_size(run, options.scale)), name) for label, run in runs.items())
    size = f"--steps {options.steps} --scale {options.scale:g}"
    command = f"python -m benchmarks.borrowed_host DATA/{name} {size}"
    result = Result(TABLE, revision(), command, hardware(), rows)
    print(markdown([result]))
    if options.save is not None:
        write_result(RESULTS / f"{options.save}.json", result)


if __name__ == "__main__":
    run_benchmark(lambda: main(tyro.cli(Options)))
