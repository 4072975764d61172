"""`neilfpp export`: write a run's surface, its light, and a textured asset as files for other programs."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from rich.console import Console

from neilfpp_method.export.asset.command import AssetOptions, Bar, Deviations, check_asset, export_asset
from neilfpp_method.export.light import check_light, export_light
from neilfpp_method.export.mesh import check_resolution, export_mesh, has_surface
from neilfpp_method.train.device import pick_device
from neilfpp_method.train.output import check_folder
from neilfpp_method.train.run import load_run

__all__ = ["ExportRequest", "run_export"]


@dataclass(frozen=True)
class ExportRequest:
    """What is exported, and how.

    Attributes:
        run: the run's folder.
        out: the folder to write; None for `RUN/export`.
        what: some of "mesh", "light" and "asset"; if empty, mesh and light as far as the run has them.
        probes: number of light probes (`export_light`).
        asset: options of the asset; its resolution is also that of the mesh.
        deviations: computes expected errors for a texture of the asset; None for no such texture.
        checkpoint: name of the checkpoint to load.
        device: device on which the run is evaluated.
    """

    run: Path
    out: Path | None
    what: Collection[str]
    probes: int | None
    asset: AssetOptions
    deviations: Deviations | None
    checkpoint: str
    device: str


def run_export(request: ExportRequest, bar: Bar, console: Console) -> None:
    """Write `mesh.ply`, `light/` and `asset/` into a folder.

    Everything requested is checked before anything is written.

    Args:
        request: what is exported.
        bar: shows a progress bar.
        console: receives messages for the user.

    Raises:
        UserError: the run does not have what is requested.
    """
    resolution, probes = request.asset.resolution, request.probes
    check_resolution(resolution)
    run = load_run(request.run, pick_device(request.device), request.checkpoint)
    out = request.out or request.run / "export"
    check_folder(out)
    available = {"mesh": has_surface(run), "light": run.has_material}
    what = request.what or [name for name, exists in available.items() if exists] or ["mesh"]
    if "light" in what:
        check_light(run, probes)
    if "asset" in what:
        check_asset(run, request.asset)
    if "mesh" in what:
        mesh = export_mesh(run, out / "mesh.ply", resolution, partial(console.print, soft_wrap=True))
        size = f"{len(mesh.vertices)} vertices, {len(mesh.faces)} faces"
        console.print(f"{size}, written to {out / 'mesh.ply'}", soft_wrap=True)
    if "light" in what:
        light = export_light(run, out / "light", probes)
        parts = ["an environment map", f"{light.lamps} lamps"] if light.environment else []
        parts.append(f"{light.probes} probes")
        console.print(f"{', '.join(parts)}, written to {out / 'light'}", soft_wrap=True)
    if "asset" in what:
        export_asset(run, out / "asset", request.asset, request.deviations, bar, console)
