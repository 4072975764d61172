"""The light of a run as files: environment map, lamps before it, and light probes (docs/light.md).

<out>/environment.exr    radiance from far away, where the run has an environment map <out>/lamps.json
lamps close to the scene, in the world frame of the capture; beside every environment map <out>/probes/<k>.exr
what arrives at points of the surface <out>/probes.json        where these points are
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jaxtyping import Float
from torch import Tensor

from neilfpp_method.data.images import write_exr
from neilfpp_method.errors import UserError
from neilfpp_method.export.probes import probe, spread_over_surface
from neilfpp_method.fields.environment import EnvironmentLight
from neilfpp_method.train.run import Run, write_json

__all__ = ["ExportedLight", "check_light", "export_light", "has_light", "lamps_in_world"]

FORMAT = 1
PROBE_HEIGHT = 64
FREE_PROBES = 16
"""Probes of a light that is free at every point, of which nothing else can be exported."""
MAX_PROBES = 1024


@dataclass(frozen=True)
class ExportedLight:
    """What was written: the map or none, and how many lamps and probes."""

    environment: Path | None
    lamps: int
    probes: int


def has_light(run: Run) -> bool:
    """Whether a stage has moved the light."""
    return run.step > run.config.train.sdf_steps


def check_light(run: Run, probes: int | None) -> None:
    """That there is what `export_light` is asked for.

    Raises:
        UserError: no stage has moved the light, or the number of probes is not within 0 … 1024.
    """
    if not has_light(run):
        raise UserError(f"{run.path}: there is no light yet at step {run.step}", "train the next stage")
    if probes is not None and not 0 <= probes <= MAX_PROBES:
        raise UserError(f"{probes} probes", f"ask for 0 to {MAX_PROBES} with --probes")


def export_light(run: Run, out: Path, probes: int | None = None) -> ExportedLight:
    """Write the light of a run. Radiance is in image units, lengths in those of the capture's world.

    Args:
        run: the run.
        out: the folder to write.
        probes: how many; none: 16 for a light that is free at every point, else 0.

    Raises:
        UserError: see `check_light`; or there is no surface for probes.
    """
    check_light(run, probes)
    light, lamps, environment = run.model.light, 0, None
    if isinstance(light, EnvironmentLight):
        environment = out / "environment.exr"
        write_exr(environment, {"RGB": light.log_radiance.exp().permute(1, 2, 0).cpu().numpy()})
        described = lamps_in_world(run)
        lamps = len(described)
        write_json(out / "lamps.json", {"format": FORMAT, "frame": "world", "lamps": described})
    if probes is None:
        probes = 0 if environment else FREE_PROBES
    written = _write_probes(run, out, probes) if probes else 0
    return ExportedLight(environment, lamps, written)


def lamps_in_world(run: Run) -> list[dict[str, Any]]:
    """The lamps of a run as in `lamps.json` (docs/light.md), in the capture's world; none without lamps.

    Radiance is the same in every frame; intensity, radiance times a disc's area, scales as the area.
    """
    lamps = run.model.lamps
    frame = run.capture.normalisation
    lit = slice(lamps.lit)
    positions = frame.to_world(lamps.position[lit].double()).tolist()
    axes = [axis if any(axis) else None for axis in lamps.axis[lit].tolist()]
    intensities = (lamps.intensity[lit].double() * frame.scale**2).tolist()
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


def _write_probes(run: Run, out: Path, count: int) -> int:
    points = spread_over_surface(run, count)
    described = []
    for position, normal in zip(points.position, points.normal, strict=True):
        name = f"probes/{len(described):04d}.exr"
        write_exr(out / name, {"RGB": probe(run, position, normal, PROBE_HEIGHT).cpu().numpy()})
        described.append({"file": name, "position": _in_world(run, position), "normal": normal.tolist()})
    # Last: what it lists is there.
    write_json(out / "probes.json", {"format": FORMAT, "frame": "world", "probes": described})
    return len(described)


def _in_world(run: Run, position: Float[Tensor, " 3"]) -> list[float]:
    return run.capture.normalisation.to_world(position.double()).tolist()
