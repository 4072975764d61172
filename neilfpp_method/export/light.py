"""Write the light of a run to files: environment map, lamps, and light probes (docs/light.md).

Files:

    <out>/environment.exr    radiance of distant light, if the run has an environment map
    <out>/lamps.json         lamps near the scene, in the world frame; written with every environment map
    <out>/probes/<k>.exr     incident radiance at points of the surface
    <out>/probes.json        positions and normals of these points
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jaxtyping import Float
from torch import Tensor

from neilfpp_method.data.files.images import write_exr
from neilfpp_method.data.files.json_entry import write_json
from neilfpp_method.errors import UserError
from neilfpp_method.export.probes import probe, spread_over_surface
from neilfpp_method.fields.environment import EnvironmentLight
from neilfpp_method.structures import OrientedPoints
from neilfpp_method.train.run import Run

__all__ = ["ExportedLight", "check_light", "export_light", "lamps_in_world"]

FORMAT = 1
"""Version of the format of the JSON files."""
PROBE_HEIGHT = 64
"""Height of the image of a probe, pixels."""
FREE_PROBES = 16
"""Default number of probes for a free light, which can only be exported as probes."""
MAX_PROBES = 1024
"""Largest number of probes."""


@dataclass(frozen=True)
class ExportedLight:
    """What was written: the file of the environment map or None, and the numbers of lamps and probes."""

    environment: Path | None
    lamps: int
    probes: int


def check_light(run: Run, probes: int | None) -> None:
    """Check that `export_light` is possible.

    Raises:
        UserError: no stage has estimated the light, or the number of probes is not within 0 … 1024.
    """
    if not run.has_material:
        raise UserError(f"{run.path}: there is no light yet at step {run.step}", "train the next stage")
    if probes is not None and not 0 <= probes <= MAX_PROBES:
        raise UserError(f"cannot export {probes} probes", f"give 0 to {MAX_PROBES} with --probes")


def export_light(run: Run, out: Path, probes: int | None = None) -> ExportedLight:
    """Write the light of a run. Radiance is in the unit of the images, lengths are in world units.

    Args:
        run: the run.
        out: the folder to write.
        probes: number of probes; None for 16 if the light is free, else 0.

    Raises:
        UserError: `check_light` fails, or there is no surface for probes; then nothing is written. Or a file
            cannot be written.
    """
    check_light(run, probes)
    light, lamps, environment = run.model.light, 0, None
    if probes is None:
        probes = 0 if isinstance(light, EnvironmentLight) else FREE_PROBES
    # Chosen before anything is written, because there may be no surface.
    points = spread_over_surface(run, probes) if probes else None
    if isinstance(light, EnvironmentLight):
        environment = out / "environment.exr"
        write_exr(environment, {"RGB": light.log_radiance.exp().permute(1, 2, 0).cpu().numpy()})
        entries = lamps_in_world(run)
        lamps = len(entries)
        write_json(out / "lamps.json", {"format": FORMAT, "frame": "world", "lamps": entries})
    if points is not None:
        _write_probes(run, out, points)
    return ExportedLight(environment, lamps, 0 if points is None else len(points))


def lamps_in_world(run: Run) -> list[dict[str, Any]]:
    """The lamps of a run in the format of `lamps.json` (docs/light.md), in the world frame.

    Radiance is the same in every frame. Intensity is radiance times the area of a disc, so it scales with the
    square of length.
    """
    lamps = run.model.lamps
    frame = run.capture.normalization
    used = slice(lamps.count)
    positions = frame.to_world(lamps.position[used].double()).tolist()
    axes = [axis if any(axis) else None for axis in lamps.axis[used].tolist()]
    intensities = (lamps.intensity[used].double() * frame.scale**2).tolist()
    return [
        {
            "position": position,
            "axis": axis,
            "radius": lamps.radius * frame.scale,
            "intensity": intensity,
            "radiance": radiance,
        }
        for position, axis, intensity, radiance in zip(
            positions, axes, intensities, lamps.radiance().tolist(), strict=True
        )
    ]


def _write_probes(run: Run, out: Path, points: OrientedPoints) -> None:
    entries = []
    for position, normal in zip(points.position, points.normal, strict=True):
        name = f"probes/{len(entries):04d}.exr"
        write_exr(out / name, {"RGB": probe(run, position, normal, PROBE_HEIGHT).cpu().numpy()})
        entries.append({"file": name, "position": _in_world(run, position), "normal": normal.tolist()})
    # Written last, so that all files which it lists exist.
    write_json(out / "probes.json", {"format": FORMAT, "frame": "world", "probes": entries})


def _in_world(run: Run, position: Float[Tensor, " 3"]) -> list[float]:
    return run.capture.normalization.to_world(position.double()).tolist()
