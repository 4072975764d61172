"""The point under a click, and the light that arrives there, unrolled."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, UInt8

from neilfpp_method.evaluate.pictures import auto_exposure, display_color, lat_long_directions
from neilfpp_method.relight.path_tracer import DIMENSIONS, trace_paths
from neilfpp_method.relight.sequence import Sequence
from neilfpp_method.relight.surface import OFFSET
from neilfpp_method.structures import Material, RayBatch
from neilfpp_method.view.subject import Lighting, Subject, scene_of

__all__ = ["Point", "light_at", "light_picture", "point_under"]

HEIGHT = 48
"""Rows of the map."""
BOUNCES, SAMPLES = 3, 16
BELOW = 44
"""Grey of directions from below the surface, from which nothing arrives."""


@dataclass(frozen=True)
class Point:
    """A point of the surface, with its unit normal; scene frame."""

    position: Float[torch.Tensor, " 3"]
    normal: Float[torch.Tensor, " 3"]
    material: Material | None


@torch.no_grad()
def point_under(subject: Subject, origin: tuple[float, ...], direction: tuple[float, ...]) -> Point | None:
    """What a ray of the scene frame meets first; none: nothing, or the inside of the surface."""
    if subject.surface is None:
        return None
    ray = torch.tensor([origin, direction], dtype=torch.float32, device=subject.device)
    met = subject.surface.cross(ray[:1], ray[1:] / ray[1:].norm())
    if not len(met.rows) or not bool(met.outside[0]):
        return None
    material = subject.run.model.materials(met.position) if subject.run.has_material else None
    return Point(met.position[0], met.normal[0], material)


@torch.no_grad()
def light_at(subject: Subject, light: Lighting, point: Point) -> Float[np.ndarray, "H W 3"]:
    """Linear radiance that arrives at a point from everywhere, in the layout of `lat_long_directions`.

    Of the run's own light as the model has it; of another as paths find it. From below the surface 0.
    """
    everywhere = torch.from_numpy(lat_long_directions(HEIGHT)).to(subject.device).reshape(-1, 3)
    above = torch.nonzero(everywhere @ point.normal > 0)[:, 0]
    directions, whole = everywhere[above], torch.zeros_like(everywhere)
    if light.own or light.sky is None:
        whole[above] = subject.run.model.incident_light(point.position[None], directions[None])[0]
    else:
        whole[above] = _by_paths(subject, light, point, directions)
    return whole.view(HEIGHT, -1, 3).cpu().numpy()


def _by_paths(
    subject: Subject, light: Lighting, point: Point, directions: Float[torch.Tensor, "D 3"]
) -> Float[torch.Tensor, "D 3"]:
    """What arrives from the surface, else from the sky, and from lamps before either."""
    scene = scene_of(subject, light)
    origins = (point.position + OFFSET * point.normal).expand_as(directions).contiguous()
    rows = torch.arange(len(directions), device=subject.device)
    numbers, total = Sequence(BOUNCES * DIMENSIONS, seed=0), torch.zeros_like(directions)
    for _ in range(SAMPLES):
        found = trace_paths(
            scene, RayBatch(origins, directions), numbers.next(1, len(rows), subject.device), BOUNCES
        )
        total += found.radiance
    met = scene.surface.cross(origins, directions)
    nearest = torch.full_like(directions[:, 0], torch.inf).index_put((met.rows,), met.distance)
    radiance = total / SAMPLES + nearest.isinf()[:, None] * scene.sky.look(directions)
    for lamp in range(0 if light.lamps is None else len(light.lamps.position)):
        distance, sent = light.lamps.meet(origins, directions, lamp)
        radiance = radiance + (distance < nearest)[:, None] * sent
    return radiance


def light_picture(
    radiance: Float[np.ndarray, "H W 3"], normal: Float[np.ndarray, " 3"]
) -> UInt8[np.ndarray, "H W 3"]:
    """The map as a display shows it; directions from below the surface are grey."""
    above = lat_long_directions(len(radiance)) @ normal > 0
    shown = display_color(radiance, auto_exposure(radiance[above]))
    return np.where(above[..., None], shown, np.uint8(BELOW))
