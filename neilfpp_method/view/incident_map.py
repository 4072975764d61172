"""The surface point under a click, and its incident light as a latitude-longitude image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, UInt8

from neilfpp_method.evaluate.pictures import auto_exposure, display_color, lat_long_directions
from neilfpp_method.relight.path_tracer import DIMENSIONS, trace_paths
from neilfpp_method.relight.sequence import SobolSequence
from neilfpp_method.relight.surface import OFFSET
from neilfpp_method.structures import Material, RayBatch
from neilfpp_method.view.subject import Lighting, Subject, scene_of

__all__ = ["SurfacePoint", "light_at", "light_picture", "point_under"]

HEIGHT = 48
"""Number of rows of the image."""
BOUNCES, SAMPLES = 3, 16
"""Largest number of surface vertices of a path, and number of paths per direction: a compromise between noise
and a response without noticeable delay.
"""
BELOW_GRAY = 44
"""Grey of directions below the surface, from which no light arrives."""


@dataclass(frozen=True)
class SurfacePoint:
    """A point of the surface with its unit normal, scene frame, and its material if there is one."""

    position: Float[torch.Tensor, " 3"]
    normal: Float[torch.Tensor, " 3"]
    material: Material | None


@torch.no_grad()
def point_under(
    subject: Subject, origin: tuple[float, ...], direction: tuple[float, ...]
) -> SurfacePoint | None:
    """First hit of a ray in the scene frame; None if it misses the surface, or hits it from the inside."""
    if subject.surface is None:
        return None
    ray = torch.tensor([origin, direction], dtype=torch.float32, device=subject.device)
    hits = subject.surface.intersect(ray[:1], ray[1:] / ray[1:].norm())
    if not len(hits.rows) or not bool(hits.outside[0]):
        return None
    material = subject.run.model.materials(hits.position) if subject.run.has_material else None
    return SurfacePoint(hits.position[0], hits.normal[0], material)


@torch.no_grad()
def light_at(subject: Subject, light: Lighting, point: SurfacePoint) -> Float[np.ndarray, "H W 3"]:
    """Incident linear radiance at a point, in the layout of `lat_long_directions`; 0 below the surface.

    The run's own light is evaluated by the model; any other light is path-traced.
    """
    all_directions = torch.from_numpy(lat_long_directions(HEIGHT)).to(subject.device).reshape(-1, 3)
    above = torch.nonzero(all_directions @ point.normal > 0)[:, 0]
    directions, radiance = all_directions[above], torch.zeros_like(all_directions)
    if light.own or light.sky is None:
        radiance[above] = subject.run.model.incident_light(point.position[None], directions[None])[0]
    else:
        radiance[above] = _by_paths(subject, light, point, directions)
    return radiance.view(HEIGHT, -1, 3).cpu().numpy()


def _by_paths(
    subject: Subject, light: Lighting, point: SurfacePoint, directions: Float[torch.Tensor, "D 3"]
) -> Float[torch.Tensor, "D 3"]:
    """Incident radiance from the surface or the sky, plus that of lamps in front of them."""
    scene = scene_of(subject, light)
    origins = (point.position + OFFSET * point.normal).expand_as(directions).contiguous()
    rows = torch.arange(len(directions), device=subject.device)
    numbers, total = SobolSequence(BOUNCES * DIMENSIONS, seed=0), torch.zeros_like(directions)
    for _ in range(SAMPLES):
        sample = numbers.next(1, len(rows), subject.device)
        total += trace_paths(scene, RayBatch(origins, directions), sample, BOUNCES).radiance
    hits = scene.surface.intersect(origins, directions)
    nearest = torch.full_like(directions[:, 0], torch.inf).index_put((hits.rows,), hits.distance)
    radiance = total / SAMPLES + nearest.isinf()[:, None] * scene.sky.lookup(directions)
    for lamp in range(0 if light.lamps is None else len(light.lamps.position)):
        met = light.lamps.intersect(origins, directions, lamp)
        radiance = radiance + (met.distance < nearest)[:, None] * met.radiance
    return radiance


def light_picture(
    radiance: Float[np.ndarray, "H W 3"], normal: Float[np.ndarray, " 3"]
) -> UInt8[np.ndarray, "H W 3"]:
    """Convert incident radiance to 8 bits with automatic exposure; directions below the surface are grey."""
    above = lat_long_directions(len(radiance)) @ normal > 0
    picture = display_color(radiance, auto_exposure(radiance[above]))
    return np.where(above[..., None], picture, np.uint8(BELOW_GRAY))
