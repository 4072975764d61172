"""Compare normals and materials of runs with the truth, by groups of true material.

    python -m benchmarks.material_groups runs/spot_city runs/spot_city@sdf_init

The captures must have true normals and materials in their test views. `RUN@STAGE` is the checkpoint at the
end of a stage. The output is a Markdown table per run with a row for each group.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import torch
import tyro
from jaxtyping import Bool, Float
from rich.console import Console
from torch import Tensor

from benchmarks.command import run_benchmark
from neilfpp_method.data.cameras.projection import camera_rays
from neilfpp_method.errors import UserError
from neilfpp_method.evaluate.views import KnownView, known_test_views
from neilfpp_method.structures import Material
from neilfpp_method.train.run import Run, load_run

__all__ = ["Compared", "compare", "markdown"]

PIXELS = 2500
"""Largest number of pixels of a view that are compared, chosen at random with a fixed seed."""
DARK = 0.4
"""Mean base colour below which paint counts as dark."""
SMOOTH, ROUGH = 0.35, 0.55
"""Roughness below which metal counts as smooth, and above which it counts as rough."""


@dataclass(frozen=True)
class Compared:
    """Pixels of the test views that show the object.

    Attributes:
        hit_error, shading_error: angle of the hit normal and of the smoothed normal to the true one, degrees.
        estimate, truth: the materials.
    """

    hit_error: Float[Tensor, " N"]
    shading_error: Float[Tensor, " N"]
    estimate: Material
    truth: Material


def compare(run: Run) -> Compared:
    """Compare random pixels of every test view.

    Raises:
        UserError: the capture has no true normals or materials.
    """
    parts = [_compare_view(run, known) for known in known_test_views(run, ()).views]
    return Compared(
        torch.cat([part.hit_error for part in parts]),
        torch.cat([part.shading_error for part in parts]),
        Material.joined([part.estimate for part in parts]),
        Material.joined([part.truth for part in parts]),
    )


@torch.no_grad()
def _compare_view(run: Run, known: KnownView) -> Compared:
    if known.normal is None or known.material is None:
        remedy = "choose a capture with normal_maps and ground_truths/materials"
        raise UserError(f"{run.capture.root}: no true normals and materials", remedy)
    normal = torch.from_numpy(known.normal).view(-1, 3)
    shown = torch.from_numpy(known.mask).view(-1) & (normal.norm(dim=1) > 0.5)
    rows = torch.nonzero(shown)[:, 0]
    rows = rows[torch.randperm(len(rows), generator=torch.Generator().manual_seed(0))[:PIXELS]]
    rays = camera_rays(run.capture.scene_camera(known.view))[rows]
    truth = {name: torch.from_numpy(values).flatten(0, 1)[rows] for name, values in known.material.items()}
    hits = run.model.host.render(rays)
    smooth = run.model.shading_normals(hits.position, hits.normal)
    return Compared(
        _angle(hits.normal, normal[rows]),
        _angle(smooth, normal[rows]),
        run.model.materials(hits.position),
        Material(**truth),
    )


def _angle(a: Float[Tensor, "N 3"], b: Float[Tensor, "N 3"]) -> Float[Tensor, " N"]:
    return torch.rad2deg(torch.cosine_similarity(a, b, dim=-1).clamp(-1, 1).acos())


def groups(truth: Material) -> Mapping[str, Bool[Tensor, " N"]]:
    """The groups of true material by name; each pixel is in "all" and in one other group."""
    metal, base = truth.metallic[:, 0] > 0.5, truth.base_color.mean(1)
    roughness = truth.roughness[:, 0]
    return {
        "all": torch.ones_like(metal),
        "dark paint": ~metal & (base < DARK),
        "light paint": ~metal & (base >= DARK),
        "smooth metal": metal & (roughness < SMOOTH),
        "satin metal": metal & (roughness >= SMOOTH) & (roughness < ROUGH),
        "rough metal": metal & (roughness >= ROUGH),
    }


def markdown(found: Compared) -> Iterator[str]:
    """The lines of a table: means over each group that has pixels, estimates with the truth in brackets."""
    yield "| pixels | share | hit normals ° | shading normals ° | base colour | roughness | metallic |"
    yield "|---|---|---|---|---|---|---|"
    for name, rows in groups(found.truth).items():
        if not rows.any():
            continue
        cells = [f"{rows.float().mean():.3f}"]
        cells += [f"{error[rows].mean():.1f}" for error in (found.hit_error, found.shading_error)]
        for field in ("base_color", "roughness", "metallic"):
            mean, true = (getattr(m, field)[rows].mean() for m in (found.estimate, found.truth))
            cells.append(f"{mean:.2f} ({true:.2f})")
        yield f"| {name} | {' | '.join(cells)} |"


def main(runs: tyro.conf.Positional[tuple[str, ...]], console: Console) -> None:
    """Print a table for each run.

    Args:
        runs: run folders, each with `@STAGE` for the weights at the end of a stage.
        console: where the tables are printed.
    """
    for argument in runs:
        folder, _, stage = argument.partition("@")
        console.print(f"\n{argument}\n", markup=False)
        for line in markdown(compare(load_run(folder, checkpoint=stage or "last"))):
            console.print(line, soft_wrap=True, markup=False)


if __name__ == "__main__":
    run_benchmark(lambda: main(tyro.cli(tuple[str, ...], description=__doc__), Console()))
