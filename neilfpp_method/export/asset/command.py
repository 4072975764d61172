"""`neilfpp export --what asset`: a textured surface, the light, and scripts for other programs."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import torch
from jaxtyping import Float
from rich.console import Console
from torch import Tensor

from neilfpp_method.errors import UserError
from neilfpp_method.export.asset.atlas import Unwrapped, unwrap
from neilfpp_method.export.asset.bake import Detail, bake
from neilfpp_method.export.asset.clean import HOLE, clean
from neilfpp_method.export.asset.files import write_asset
from neilfpp_method.export.asset.simplify import MAX_FACES, MIN_FACES, Simplified, simplified
from neilfpp_method.export.asset.surface import fine_surface
from neilfpp_method.export.asset.usd import has_usd
from neilfpp_method.export.asset.visible import visible_faces
from neilfpp_method.export.mesh import has_surface
from neilfpp_method.structures import OrientedPoints
from neilfpp_method.train.run import Run, check_material

__all__ = ["AssetOptions", "Bar", "Deviations", "check_asset", "export_asset"]

MIN_TEXTURE, MAX_TEXTURE = 64, 8192
"""Smallest and largest width of the textures, texels."""
FACES, ERROR = 30_000, 0.001
"""Default number of triangles, and default error, scene units."""
REACH_FACTOR = 2.0
"""The fine surface is searched within this multiple of the distance below which 99.9 % of its points are."""
MIN_REACH, MAX_REACH = 1e-3, 0.1
"""Bounds of the distance within which the fine surface is searched, scene units."""

Bar = Callable[[str], AbstractContextManager[Callable[[float], None]]]
"""Opens a progress bar with a title; the function it yields takes the fraction that is done."""
Deviations = Callable[[Run, OrientedPoints], Float[Tensor, "N 3"]]
"""Computes the expected errors of base colour, roughness and metallic at points of the surface."""


@dataclass(frozen=True)
class AssetOptions:
    """Options of an asset.

    Attributes:
        resolution: resolution of the fine surface (`extracted_surface`).
        texture_size: width and height of the textures, texels.
        faces: largest number of triangles; None for `FACES`. A given error is kept first.
        error: largest distance, scene units, between the surface and the simplified one; None for `ERROR`,
            which may be exceeded if `faces` is given.
        hole: largest extent, scene units, of holes that are closed.
    """

    resolution: int
    texture_size: int
    faces: int | None = None
    error: float | None = None
    hole: float = HOLE


def check_asset(run: Run, options: AssetOptions) -> None:
    """Check that `export_asset` is possible.

    Raises:
        UserError: the run has no surface or no material yet, or an option is out of range.
    """
    if not has_surface(run):
        raise UserError(
            f"{run.path}: the host of this run has no surface to export", "export from a run of another host"
        )
    check_material(run)
    if not MIN_TEXTURE <= options.texture_size <= MAX_TEXTURE:
        raise UserError(
            f"a texture cannot have {options.texture_size} texels per side",
            f"give {MIN_TEXTURE} to {MAX_TEXTURE} with --texture-size",
        )
    if options.faces is not None and not MIN_FACES <= options.faces <= MAX_FACES:
        raise UserError(
            f"an asset cannot have {options.faces} triangles",
            f"give {MIN_FACES} to {MAX_FACES} with --faces",
        )
    for name, length in (("--error", options.error), ("--holes", options.hole)):
        if length is not None and not length >= 0:
            raise UserError(f"{name} cannot be {length:g}", "give a length in scene units, 0 or larger")


@torch.no_grad()
def export_asset(
    run: Run,
    out: Path,
    options: AssetOptions,
    deviations: Deviations | None,
    bar: Bar,
    console: Console,
) -> None:
    """Write the asset of a run into a folder. Lengths are in world units.

    Args:
        run: the run, for which `check_asset` has succeeded.
        out: the folder to write.
        options: options of the asset.
        deviations: computes expected errors for an additional texture; None for no such texture.
        bar: shows the progress of baking.
        console: receives messages for the user.

    Raises:
        UserError: there is no surface, no camera sees it, the charts do not fit on the texture, or the folder
            cannot be written.
    """
    full = fine_surface(run, options.resolution, partial(console.print, soft_wrap=True))
    cameras = [run.capture.scene_camera(view) for view in run.capture.train_views]
    fine = clean(full, visible_faces(full, cameras), options.hole)
    console.print(f"surface: kept {len(fine.faces)} of {len(full.faces)} triangles, which cameras see")
    faces_first = options.faces is not None and options.error is None
    faces, error = options.faces or FACES, ERROR if options.error is None else options.error
    coarse = simplified(fine, faces, error, faces_first)
    for line in _about(coarse, faces, error, faces_first):
        console.print(line, soft_wrap=True)
    mesh = unwrap(coarse.surface, options.texture_size)
    expected = None if deviations is None else deviations(run, _points(run, mesh)).double().cpu().numpy()
    with bar("textures") as advance:
        detail = Detail(fine, reach=min(max(REACH_FACTOR * coarse.distance.near, MIN_REACH), MAX_REACH))
        textures = bake(run, mesh, detail, options.texture_size, expected, advance)
    console.print(
        f"textures: {mesh.charts} charts on {100 * textures.covered:.0f} % of {options.texture_size}² texels"
    )
    vertices = run.capture.normalization.to_world(torch.from_numpy(mesh.vertices)).numpy()
    write_asset(run, replace(mesh, vertices=vertices), textures, out)
    if not has_usd():
        remedy = "pip install 'neilfpp-method[usd]'"
        console.print(f"no USD file was written, because usd-core is missing: {remedy}", soft_wrap=True)
    console.print(f"written to {out}", soft_wrap=True)


def _about(coarse: Simplified, faces: int, error: float, faces_first: bool) -> Iterator[str]:
    """What the user reads about a simplified surface."""
    count, distance = len(coarse.surface.faces), coarse.distance
    near = f"99.9 % within {distance.near:.2g} scene units, all within {distance.largest:.2g}"
    yield f"simplified: {count} triangles, {near} of the surface"
    if count > faces:
        fewer = f"{faces} would be {coarse.wished.near:.2g} off"
        yield f"more than {faces} triangles, to keep the error {error:g} ({fewer}); for fewer, raise --error"
    if distance.near > error and not faces_first:
        yield f"the error is larger than {error:g}, because an asset has at most {MAX_FACES} triangles"


def _points(run: Run, mesh: Unwrapped) -> OrientedPoints:
    parts = (torch.from_numpy(part).float().to(run.device) for part in (mesh.vertices, mesh.normals))
    return OrientedPoints(*parts)
