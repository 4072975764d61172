"""Error of the light that remains if the material is known.

    python -m benchmarks.true_material RUN [RUN …]

The runs need a given mesh, and test views with true materials. From an even light on, the light is fitted
`--fits` times to points of these views, with their true base colour, roughness and metallic and with R of the
run. The output has the figures of `neilfpp eval` for this light and for that of the run.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from rich.console import Console
from torch import Tensor

from benchmarks.command import run_benchmark
from neilfpp_method.data.cameras.projection import camera_rays
from neilfpp_method.data.truth import Truth
from neilfpp_method.errors import UserError
from neilfpp_method.evaluate.scene_metrics import light_metrics
from neilfpp_method.evaluate.views import known_test_views, render_test_views
from neilfpp_method.fields.environment import EnvironmentLight
from neilfpp_method.fields.light import LightModel
from neilfpp_method.lighting.fit_points import FitPoints
from neilfpp_method.lighting.objective import Objective
from neilfpp_method.lighting.solve import solve_light
from neilfpp_method.structures import Material, Observed
from neilfpp_method.train.run import Run, load_run

MAPS = ("base_color", "roughness", "metallic")


@dataclass
class Options:
    """Solve for the light of runs under the true material."""

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Run folders with a given mesh and an environment map."""
    fits: int = 12
    """Number of fits, each to other points."""


@dataclass(frozen=True)
class Known:
    """Surface points of the test views with their pixels, and their true material."""

    observed: Observed
    material: Material


@torch.no_grad()
def known_points(run: Run) -> Known:
    """All pixels of the test views that hit the surface and have a true material.

    Raises:
        UserError: the capture has no true materials.
    """
    rendered = render_test_views(dataclasses.replace(run, step=0))  # without material
    parts = []
    for known in known_test_views(run, rendered).views:
        if known.material is None:
            raise UserError(f"{run.capture.root}: no true materials", "choose a capture with ground truth")
        rays = camera_rays(run.capture.scene_camera(known.view))
        hits = run.model.host.render(rays)
        rows = torch.nonzero(
            hits.is_hit(run.config.shading.hit_share) & torch.from_numpy(known.mask.reshape(-1))
        )[:, 0]
        truth = [torch.from_numpy(known.material[name]).reshape(len(rays), -1)[rows] for name in MAPS]
        image = torch.from_numpy(known.image).reshape(-1, 3)[rows]
        parts.append([hits.position[rows], hits.normal[rows], -rays.directions[rows], image, *truth])
    columns: list[Tensor] = [torch.cat(column).float() for column in zip(*parts, strict=True)]
    return Known(Observed(*columns[:4]), Material(*columns[4:]))


@torch.no_grad()
def solve_under_truth(run: Run, known: Known, fits: int) -> None:
    """Fit the light of the run again, from an even light on."""
    model, settings = run.model, run.config.light
    model.light.log_radiance.fill_(math.log(model.facts.median_radiance / 0.3))
    model.lamps.count = 0
    light = LightModel(model.light, model.lamps)
    objective = Objective(model.facts.response, model.units.physical, base_color_known=True)
    for _ in range(fits):
        rows = torch.randperm(len(known.observed.position))[: settings.fit.points]
        points = FitPoints(known.observed[rows], known.material[rows], model.lobe, model.scene)
        solve_light(light, points, objective, settings, first=False)


def line(run: Run, title: str) -> str:
    """The errors of the light of a run, and its lamps."""
    truth = Truth(run.capture)
    field = truth.light_field()
    if field is None:
        raise UserError(
            f"{run.capture.root}: no true light", "choose a capture with light/light_field_gt.npz"
        )
    figures = light_metrics(run, field, truth.mesh())
    text = f"{title:>22}: " + ", ".join(
        f"{name.removeprefix('incident_light_')} {x:.3f}" for name, x in figures.items()
    )
    lamps = run.model.lamps
    for k in range(lamps.count):
        place = run.capture.normalization.to_world(lamps.position[k]).tolist()
        text += "\n" + 24 * " " + "lamp at " + ", ".join(f"{x:.2f}" for x in place)
        text += "; axis " + ", ".join(f"{x:.2f}" for x in lamps.axis[k].tolist())
        text += "; intensity " + ", ".join(f"{x:.2f}" for x in lamps.intensity[k].tolist())
    return text


def main(options: Options) -> None:
    """Print the figures of the light of each run, and of the light under the true material."""
    console = Console()
    for path in options.runs:
        run = load_run(path)
        if not isinstance(run.model.light, EnvironmentLight):
            raise UserError(
                f"{path}: its light is no environment map",
                "choose a run with --config.light.kind auto or distant",
            )
        run.model.eval()
        console.print(str(path), highlight=False, soft_wrap=True)
        console.print(line(run, "as trained"), highlight=False, soft_wrap=True)
        torch.manual_seed(run.config.train.seed)
        solve_under_truth(run, known_points(run), options.fits)
        console.print(line(run, "under true material"), highlight=False, soft_wrap=True)


if __name__ == "__main__":
    run_benchmark(lambda: main(tyro.cli(Options)))
