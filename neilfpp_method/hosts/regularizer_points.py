"""Points at which the regularisers of G are evaluated (METHOD §4)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.fields.sdf import SdfSample
from neilfpp_method.volume.hits import HIT_RADIUS

__all__ = ["SURFACE_WIDTH", "RegularizerInputs", "regularizer_inputs"]

POINTS_ABOUT_OBJECT = 2
"""Points per ray in the cube around the object, besides one per ray in the cube around the scene (published
code: 8192 and 4096 points).
"""
SURFACE_WIDTH = {"scene": 10.0, "rays": 0.05}
"""Width ε of the smoothed delta of L_surf by `host.loss.points`, scene units; that of "scene" is the
published value.
"""


@dataclass(frozen=True)
class RegularizerInputs:
    """Inputs of the regularisers: ∇G for L_Eik, G for L_surf, and points for L_Hess."""

    gradient: Float[Tensor, "A 3"]
    distance: Float[Tensor, " B"]
    hessian_points: Float[Tensor, "C 3"]


def regularizer_inputs(
    points: Literal["scene", "rays"],
    samples: SdfSample,
    hits: Float[Tensor, "N 3"],
    field: Callable[[Float[Tensor, "P 3"]], SdfSample],
    radius: float,
) -> RegularizerInputs:
    """Inputs of the regularisers in a step.

    Args:
        points: `host.loss.points`. "rays": the samples of the rays, and points around the hits for L_Hess;
            "scene": random points of the scene, with one sample of each ray for L_Eik.
        samples: G at the samples of the rays, ray by ray.
        hits: positions of the hits of the rays, scene frame.
        field: G with its gradient, queried at the random points.
        radius: radius of the scene sphere, scene units.
    """
    hits = hits.detach()
    if points == "rays":
        around = hits + HIT_RADIUS * torch.randn_like(hits)
        return RegularizerInputs(samples.gradient, samples.distance, around)
    about_object = torch.empty_like(hits).repeat(POINTS_ABOUT_OBJECT, 1).uniform_(-1.0, 1.0)
    anywhere = torch.empty_like(hits).uniform_(-1.0, 1.0) * radius
    drawn = torch.cat((about_object, anywhere))
    at_points = field(drawn)
    rays, per_ray = len(hits), len(samples.distance) // len(hits)
    of_ray = torch.arange(rays, device=hits.device) * per_ray
    of_ray = of_ray + torch.randint(per_ray, (rays,), device=hits.device)
    gradient = torch.cat((at_points.gradient, samples.gradient[of_ray]))
    return RegularizerInputs(gradient, at_points.distance, drawn)
