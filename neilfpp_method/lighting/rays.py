"""Rays from surface points, drawn by several techniques and traced through the scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.shading.frame import dot
from neilfpp_method.shading.sampling import Technique, combine
from neilfpp_method.structures import Observed, SceneLight, SceneTracer

__all__ = ["TracedRays", "from_scene", "trace_rays", "unblocked"]


@dataclass(frozen=True)
class TracedRays:
    """S rays from each of N surface points.

    Attributes:
        wi: their unit directions.
        weight: cosine about the normal of the point, divided by the number of rays and by the density: a sum
            over the rays estimates an integral over the hemisphere.
        scene_light: the light that the rays meet in the scene, and which rays meet it; None without a scene.
    """

    wi: Float[Tensor, "N S 3"]
    weight: Float[Tensor, "N S"]
    scene_light: SceneLight | None


@torch.no_grad()
def trace_rays(
    observed: Observed, techniques: Sequence[tuple[Technique, int]], scene: SceneTracer | None
) -> TracedRays:
    """Draw rays by techniques, combined by the balance heuristic, and trace them.

    Args:
        observed: the surface points, with unit normals.
        techniques: each draws that number of rays per point.
        scene: traces rays from the points through the scene; None if the light of the scene is off.
    """
    drawn = combine(techniques, stochastic=True)
    weight = dot(drawn.wi, observed.normal).clamp_min(0) / (drawn.wi.shape[1] * drawn.pdf)
    scene_light = None if scene is None else scene(observed.position, drawn.wi)
    return TracedRays(drawn.wi, weight, scene_light)


def unblocked(kernel: Float[Tensor, "K N S"], met: SceneLight | None) -> Float[Tensor, "K N S"]:
    """The kernel of rays, with 0 where the scene blocks the map."""
    return kernel if met is None else kernel * ~met.hit


def from_scene(kernel: Float[Tensor, "K N S"], met: SceneLight | None) -> Float[Tensor, "K N 3"]:
    """Outgoing radiance due to the surfaces that rays meet, through the kernel of the rays."""
    if met is None:
        return kernel.new_zeros(*kernel.shape[:2], 3)
    return torch.einsum("kns,nsc->knc", kernel, met.radiance.to(kernel.dtype))
