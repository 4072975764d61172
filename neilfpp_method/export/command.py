"""`neilfpp export`: a run's surface and its light as files for other programs."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

from rich.console import Console

from neilfpp_method.export.light import check_light, export_light, has_light
from neilfpp_method.export.mesh import HasSdf, export_mesh
from neilfpp_method.train.device import pick_device
from neilfpp_method.train.run import check_writable, load_run

__all__ = ["run_export"]


def run_export(
    *,
    run: Path,
    what: Collection[str],
    out: Path | None,
    resolution: int,
    probes: int | None,
    checkpoint: str,
    device: str,
    console: Console,
) -> None:
    """Write `mesh.ply` and `light/` into a folder, `RUN/export` where none is given.

    Args:
        run: the run's folder.
        what: "mesh", "light", or both; none: what the run has.
        resolution: of `export_mesh`.
        probes: of `export_light`.

    Raises:
        UserError: the run does not have what is asked for.
    """
    trained = load_run(run, pick_device(device), checkpoint)
    out = out or run / "export"
    check_writable(out)
    has = {"mesh": isinstance(trained.model.host, HasSdf), "light": has_light(trained)}
    what = what or [name for name, there in has.items() if there] or ["mesh"]
    if "light" in what:
        check_light(trained, probes)
    if "mesh" in what:
        mesh = export_mesh(trained, out / "mesh.ply", resolution)
        size = f"{len(mesh.vertices)} vertices, {len(mesh.faces)} faces"
        console.print(f"{size}, written to {out / 'mesh.ply'}", soft_wrap=True)
    if "light" in what:
        light = export_light(trained, out / "light", probes)
        parts = (["an environment map", f"{light.lamps} lamps"] if light.environment else []) + [f"{light.probes} probes"]
        console.print(f"{', '.join(parts)}, written to {out / 'light'}", soft_wrap=True)
