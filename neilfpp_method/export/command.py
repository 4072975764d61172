"""`neilfpp export`: write a run's surface, its light, and a textured asset as files for other programs."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

from rich.console import Console

from neilfpp_method.export.asset.command import AssetOptions, Bar, Deviations, check_asset, export_asset
from neilfpp_method.export.light import check_light, export_light
from neilfpp_method.export.mesh import check_resolution, export_mesh, has_surface
from neilfpp_method.train.device import pick_device
from neilfpp_method.train.output import check_folder
from neilfpp_method.train.run import load_run

__all__ = ["run_export"]


def run_export(
    *,
    run: Path,
    what: Collection[str],
    out: Path | None,
    resolution: int,
    probes: int | None,
    asset: AssetOptions,
    deviations: Deviations | None,
    bar: Bar,
    checkpoint: str,
    device: str,
    console: Console,
) -> None:
    """Write `mesh.ply`, `light/` and `asset/` into a folder.

    Everything requested is checked before anything is written.

    Args:
        run: the run's folder.
        what: some of "mesh", "light" and "asset"; if empty, mesh and light as far as the run has them.
        out: the folder to write; None for `RUN/export`.
        resolution: resolution of the extracted surface (`extract_mesh`).
        probes: number of light probes (`export_light`).
        asset: options of the asset.
        deviations: computes expected errors for a texture of the asset; None for no such texture.
        bar: shows a progress bar.
        checkpoint: name of the checkpoint to load.
        device: device on which the run is evaluated.
        console: receives messages for the user.

    Raises:
        UserError: the run does not have what is requested.
    """
    check_resolution(resolution)
    trained = load_run(run, pick_device(device), checkpoint)
    out = out or run / "export"
    check_folder(out)
    available = {"mesh": has_surface(trained), "light": trained.has_material}
    what = what or [name for name, exists in available.items() if exists] or ["mesh"]
    if "light" in what:
        check_light(trained, probes)
    if "asset" in what:
        check_asset(trained, asset)
    if "mesh" in what:
        mesh = export_mesh(trained, out / "mesh.ply", resolution)
        size = f"{len(mesh.vertices)} vertices, {len(mesh.faces)} faces"
        console.print(f"{size}, written to {out / 'mesh.ply'}", soft_wrap=True)
    if "light" in what:
        light = export_light(trained, out / "light", probes)
        parts = ["an environment map", f"{light.lamps} lamps"] if light.environment else []
        parts.append(f"{light.probes} probes")
        console.print(f"{', '.join(parts)}, written to {out / 'light'}", soft_wrap=True)
    if "asset" in what:
        export_asset(trained, out / "asset", resolution, asset, console, bar, deviations)
