"""`neilfpp export --what asset`: a textured surface, the light, and scripts that open both elsewhere."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float
from rich.console import Console
from torch import Tensor

from neilfpp_method.errors import UserError
from neilfpp_method.export.asset.atlas import Unwrapped, unwrap
from neilfpp_method.export.asset.bake import bake
from neilfpp_method.export.asset.clean import clean
from neilfpp_method.export.asset.files import write_asset
from neilfpp_method.export.asset.simplify import MIN_FACES, simplified
from neilfpp_method.export.asset.surface import fine_surface
from neilfpp_method.export.asset.usd import has_usd
from neilfpp_method.export.asset.visible import seen_faces
from neilfpp_method.export.mesh import has_surface
from neilfpp_method.structures import OrientedPoints
from neilfpp_method.train.run import Run

__all__ = ["AssetOptions", "Bar", "Deviations", "check_asset", "export_asset"]

MIN_TEXTURE, MAX_TEXTURE = 64, 8192
"""Texels along an edge of the textures."""
MAX_FACES = 200_000
"""Beyond which xatlas takes minutes."""
REACH_FACTOR = 2.0
"""The fine surface is looked for within so many times the distance that 99 of 100 of its points keep."""
MIN_REACH = 1e-3
"""Scene units."""

Bar = Callable[[str], AbstractContextManager[Callable[[float], None]]]
"""A progress bar of this title, which takes the share that is done."""
Deviations = Callable[[Run, OrientedPoints], Float[Tensor, "N 3"]]
"""How far off base colour, roughness and metallic may be at points of the surface."""


@dataclass(frozen=True)
class AssetOptions:
    """What an asset should be like; see the options of `neilfpp export`."""

    texture_size: int
    faces: int
    error: float


def check_asset(run: Run, options: AssetOptions) -> None:
    """That there is what `export_asset` is asked for.

    Raises:
        UserError: no surface, no material yet, or options out of range.
    """
    if not has_surface(run):
        raise UserError(
            f"{run.path}: the host of this run has no surface to export", "export from a run of another host"
        )
    if run.step <= run.config.train.sdf_steps:
        raise UserError(f"{run.path}: there is no material yet at step {run.step}", "train the next stage")
    if not MIN_TEXTURE <= options.texture_size <= MAX_TEXTURE:
        raise UserError(
            f"a texture of {options.texture_size} texels a side", f"ask for {MIN_TEXTURE} to {MAX_TEXTURE}"
        )
    if not MIN_FACES <= options.faces <= MAX_FACES:
        raise UserError(
            f"an asset of {options.faces} triangles", f"ask for {MIN_FACES} to {MAX_FACES} with --faces"
        )
    if not options.error >= 0:
        raise UserError(f"--error {options.error:g}", "give a length in scene units, from 0 on")


@torch.no_grad()
def export_asset(
    run: Run,
    out: Path,
    resolution: int,
    options: AssetOptions,
    console: Console,
    bar: Bar,
    deviations: Deviations | None,
) -> None:
    """Write the asset of a run into a folder; lengths are those of the capture's world.

    Args:
        run: the run; `check_asset` has passed.
        out: the folder.
        resolution: of the fine surface (`extract_mesh`).
        options: see there.
        console: is told what comes out.
        bar: shows how far the baking is.
        deviations: for a texture of them; none: no such texture.

    Raises:
        UserError: no surface, none that a camera sees, an atlas that does not fit, or a folder that cannot be
            written.
    """
    whole = fine_surface(run, resolution)
    cameras = [run.capture.normalisation.camera(view.camera) for view in run.capture.train_views]
    fine = clean(whole, seen_faces(whole, cameras))
    console.print(f"surface: {len(fine.faces)} of {len(whole.faces)} triangles were seen and stay")
    coarse = simplified(fine, options.faces, options.error)
    distance = coarse.distance
    near = f"99 % of the surface within {distance.near:.2g} scene units"
    lost = f", {100 * distance.missed:.1f} % lost" if distance.missed > 0 else ""
    console.print(f"simplified: {len(coarse.surface.faces)} triangles, {near}{lost}")
    mesh = unwrap(coarse.surface, options.texture_size)
    unsure = None if deviations is None else deviations(run, _points(run, mesh)).double().cpu().numpy()
    with bar("textures") as advance:
        reach = max(REACH_FACTOR * distance.near, MIN_REACH)
        textures = bake(run, mesh, fine, reach, options.texture_size, unsure, advance)
    console.print(
        f"textures: {mesh.charts} charts on {100 * textures.covered:.0f} % of {options.texture_size}² texels"
    )
    vertices = run.capture.normalisation.to_world(torch.from_numpy(mesh.vertices)).numpy()
    write_asset(run, replace(mesh, vertices=vertices), textures, out)
    if not has_usd():
        console.print("no USD file: `pip install neilfpp-method[usd]` adds what writes it")
    console.print(f"written to {out}", soft_wrap=True)


def _points(run: Run, mesh: Unwrapped) -> OrientedPoints:
    device = next(run.model.parameters()).device
    parts = (torch.from_numpy(part).float().to(device) for part in (mesh.vertices, mesh.normals))
    return OrientedPoints(*parts)
