"""Incident radiance along given directions, from the light, the scene that may occlude it, and the lamps."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.fields.lamps import Lamps
from neilfpp_method.fields.light import Light
from neilfpp_method.structures import Incident, IncidentSamples, SceneLight, SceneTracer, Source

__all__ = ["Sources", "arriving", "incident_radiance"]


@dataclass(frozen=True)
class Sources:
    """Everything that may send light to a surface point.

    Attributes:
        light: an environment map, or a light field that is free at every point.
        lamps: small lamps near the scene, possibly none lit.
        scene: traces the scene's own surfaces, which occlude light and lamps. If None, nothing is traced, and
            the light field is all the light that arrives at a point.
    """

    light: Light
    lamps: Lamps
    scene: SceneTracer | None


def arriving(sources: Sources, x: Float[Tensor, "N 3"], drawn: IncidentSamples) -> Incident:
    """Compute the light that arrives at surface points along sampled directions and from the lamps.

    The sampled directions do not hit lamps. Each lamp adds a direction of its own, with a shadow ray if
    there is a scene. The sum over all directions of weight · radiance · f · cos θ then estimates the integral
    of the rendering equation.

    Args:
        sources: light, lamps and scene.
        x: surface points, scene frame.
        drawn: sampled incident directions with their pdf.

    Returns:
        S incident directions per point, and one more for each lit lamp. Gradients reach the light.
    """
    incident = _from_light(sources, x, drawn)
    return incident.concatenate(_from_lamps(sources, x)) if sources.lamps.count else incident


def incident_radiance(
    sources: Sources, x: Float[Tensor, "N 3"], wi: Float[Tensor, "N S 3"]
) -> Float[Tensor, "N S 3"]:
    """Linear radiance that arrives at x from directions wi, including lamps that a direction hits."""
    if sources.scene is None:
        radiance, nearest = sources.light.radiance(x, wi), torch.full_like(wi[..., 0], torch.inf)
    else:
        scene = sources.scene(x, wi)
        radiance, nearest = _behind_scene(scene, sources.light, x, wi), scene.distance
    return radiance + sources.lamps.radiance_along(x, wi, nearest) if sources.lamps.count else radiance


def _from_light(sources: Sources, x: Float[Tensor, "N 3"], drawn: IncidentSamples) -> Incident:
    if sources.scene is None:
        return Incident.of(drawn, sources.light.radiance(x, drawn.wi))
    scene = sources.scene(x, drawn.wi)
    source = torch.where(scene.hit, Source.SCENE, Source.LIGHT)
    return Incident.of(drawn, _behind_scene(scene, sources.light, x, drawn.wi), source)


def _from_lamps(sources: Sources, x: Float[Tensor, "N 3"]) -> Incident:
    rays = sources.lamps.rays_from(x)
    radiance = sources.lamps.arriving(rays)
    if sources.scene is not None:
        radiance = radiance * rays.visibility(x, sources.scene)[..., None]
    number = Source.LAMPS + torch.arange(sources.lamps.count, device=x.device)
    return Incident(rays.wi, radiance, rays.solid_angle, number.expand(rays.distance.shape))


def _behind_scene(
    scene: SceneLight, light: Light, x: Float[Tensor, "N 3"], wi: Float[Tensor, "N S 3"]
) -> Float[Tensor, "N S 3"]:
    """The scene's radiance where a direction hits it, else the light's, which is only evaluated there."""
    point, direction = torch.nonzero(~scene.hit, as_tuple=True)
    beyond = light.radiance(x[point], wi[point, direction][:, None])[:, 0]
    # Within autocast a light field returns half precision.
    return scene.radiance.index_put((point, direction), beyond.to(scene.radiance.dtype))
