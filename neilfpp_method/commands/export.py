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
    """Write a run's surface, its light, or a textured asset for other programs, in the capture's frame."""

    run: tyro.conf.Positional[Path]
    """The run's folder."""
    what: tuple[Literal["mesh", "light", "asset"], ...] = ()
    """mesh: the surface (PLY). light: environment map (EXR), lamps (JSON), probes (EXR). asset: textures,
    GLB, USD, light, and scripts for Blender and Mitsuba (docs/assets.md). None named: mesh and light, as far
    as the run has them."""
    out: Path | None = None
    """The folder; none: RUN/export."""
    resolution: int = 256
    """Cells of the mesh along an edge of the scene's cube."""
    probes: int | None = None
    """Light probes, spread over the surface; none: 16 for a light that is free at every point, else 0."""
    texture_size: int = 2048
    """Texels along an edge of the asset's textures."""
    faces: int = 30_000
    """Most triangles of the asset."""
    error: float = 0.001
    """Largest error of the asset's simplified triangles, scene units; a normal map keeps finer relief."""
    confidence: bool = False
    """Add a texture of the expected error of base colour, roughness and metallic; takes twice as long."""
    checkpoint: Checkpoint = "last"
    """Which weights."""
    device: Device = "auto"
    """Where to compute."""


def run(options: Export) -> None:
    from neilfpp_method.evaluate.confidence import deviations_at
    from neilfpp_method.export.asset.command import AssetOptions
    from neilfpp_method.export.command import run_export
    from neilfpp_method.kernels.process import computing_fast

    with computing_fast():
        run_export(
            run=options.run,
            what=options.what,
            out=options.out,
            resolution=options.resolution,
            probes=options.probes,
            asset=AssetOptions(options.texture_size, options.faces, options.error),
            deviations=deviations_at if options.confidence else None,
            bar=progress_bar,
            checkpoint=options.checkpoint,
            device=options.device,
            console=terminal(),
        )


COMMAND = Command(
    Export,
    run,
    [
        "neilfpp export runs/teapot --resolution 512",
        "neilfpp export runs/teapot --what light --probes 32 --out teapot",
        "neilfpp export runs/teapot --what asset --texture-size 4096 --faces 50000",
    ],
)
