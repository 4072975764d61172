"""The transport from small lamps near the scene (see `transport`)."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from neilfpp_method.fields.lamps import LampPlaces, rays_towards
from neilfpp_method.lighting.transport import Transport, brdf_kernel, spans
from neilfpp_method.shading.brdf import Lobe
from neilfpp_method.shading.frame import dot
from neilfpp_method.structures import Observed, SceneTracer

__all__ = ["from_lamps", "in_sight", "lamp_kernel"]


@torch.no_grad()
def from_lamps(
    lamps: LampPlaces,
    radius: float,
    observed: Observed,
    roughness: Float[Tensor, "N 1"],
    lobe: Lobe | None,
    scene: SceneTracer | None,
) -> Transport:
    """The transport from small lamps, per unit of intensity; shadow rays go to their centres.

    Args:
        lamps: positions and axes of the lamps.
        radius: radius of every lamp, in scene units.
        observed: the surface points, with unit normals and directions to the viewer.
        roughness: roughness at the points.
        lobe: the specular lobe; None for Lambertian surfaces.
        scene: traces shadow rays through the scene; None if inter-reflection is off.
    """
    sources = []
    for span in spans(len(observed), len(lamps.position)):
        part = observed[span]
        sight = in_sight(lamps, radius, part.position, scene)
        sources.append(lamp_kernel(lamps, radius, sight, part, roughness[span], lobe))
    kernel = torch.cat(sources, 1)
    return Transport(kernel, kernel.new_zeros(*kernel.shape[:2], 3))


@torch.no_grad()
def in_sight(
    lamps: LampPlaces, radius: float, x: Float[Tensor, "N 3"], scene: SceneTracer | None
) -> Bool[Tensor, "N M"]:
    """Whether the centre of a lamp is visible from a point (see `LampRays.visibility`)."""
    return rays_towards(x, lamps.position, lamps.axis, radius).visibility(x, scene)


def lamp_kernel(
    lamps: LampPlaces,
    radius: float,
    sight: Bool[Tensor, "N M"],
    observed: Observed,
    roughness: Float[Tensor, "N 1"],
    lobe: Lobe | None,
) -> Float[Tensor, "K N M"]:
    """The `sources` of a transport from lamps, differentiable in their positions and axes.

    The visibility `sight` is a constant; see `in_sight`.
    """
    rays = rays_towards(observed.position, lamps.position, lamps.axis, radius)
    weight = sight * rays.emission * dot(rays.wi, observed.normal).clamp_min(0) / rays.distance.square()
    return brdf_kernel(observed, roughness, rays.wi, weight, lobe)
