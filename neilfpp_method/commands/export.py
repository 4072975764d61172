"""`neilfpp export`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from neilfpp_method.commands.command import Checkpoint, Command, Device, progress_bar, terminal

__all__ = ["COMMAND"]


@dataclass
class Export:
    """Export the surface, the light, or a textured asset for other programs, in the capture's frame."""

    run: tyro.conf.Positional[Path]
    """The run folder."""
    what: tuple[Literal["mesh", "light", "asset"], ...] = ()
    """mesh: the surface (PLY). light: environment map (EXR), lamps (JSON), probes (EXR). asset: textures,
    GLB, USD, light, and scripts for Blender and Mitsuba (docs/assets.md). Default: mesh and light, if the run
    has them."""
    out: Path | None = None
    """Output folder; default: RUN/export."""
    resolution: int = 256
    """Cells of the marching-cubes grid along an edge of the scene's cube."""
    probes: int | None = None
    """Number of light probes on the surface; default: 16 for the free light field, otherwise 0."""
    texture_size: int = 2048
    """Width and height of the asset's textures, in texels."""
    faces: int | None = None
    """Maximum number of triangles of the asset; default: 30000. Given without --error, it is always kept.
    Otherwise the error is kept first, and the command reports if that takes more triangles."""
    error: float | None = None
    """Maximum distance of the simplified surface and the full one from one another, for 99.9 % of both, in
    scene units (the object lies in a ball of radius 1); default: 0.001. A normal map represents finer
    relief."""
    holes: float = 0.05
    """Maximum width of holes in the asset's surface that are closed, in scene units; 0 closes none. Holes
    are parts that no camera saw."""
    confidence: bool = False
    """Add a texture of the expected error of base colour, roughness and metallic; takes twice as long."""
    checkpoint: Checkpoint = "last"
    """Checkpoint to export."""
    device: Device = "auto"
    """Device to compute on."""


def run(options: Export) -> None:
    from neilfpp_method.evaluate.confidence import deviations_at
    from neilfpp_method.export.asset.command import AssetOptions
    from neilfpp_method.export.command import ExportRequest, run_export
    from neilfpp_method.kernels.process import computing_fast

    request = ExportRequest(
        run=options.run,
        out=options.out,
        what=options.what,
        probes=options.probes,
        asset=AssetOptions(
            options.resolution, options.texture_size, options.faces, options.error, options.holes
        ),
        deviations=deviations_at if options.confidence else None,
        checkpoint=options.checkpoint,
        device=options.device,
    )
    with computing_fast():
        run_export(request, progress_bar, terminal())


COMMAND = Command(
    Export,
    run,
    [
        "neilfpp export runs/teapot --resolution 512",
        "neilfpp export runs/teapot --what light --probes 32 --out teapot",
        "neilfpp export runs/teapot --what asset --texture-size 4096 --faces 50000",
    ],
)
