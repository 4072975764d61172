"""The outputs of the method for nerfstudio's viewer and evaluation: all maps of rays by name."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.model import NeilfModel
from neilfpp_method.shading.color import apply_response
from neilfpp_method.shading.sampling import combine, cosine
from neilfpp_method.structures import Maps, RayBatch

__all__ = ["mean_incident_light", "method_outputs"]


def method_outputs(neilf: NeilfModel, rays: RayBatch, maps: Maps) -> dict[str, Tensor]:
    """Name the maps of rays as nerfstudio does; `rgb` and `rgb_volume` are in the response of the capture.

    Args:
        neilf: the method, in evaluation mode.
        rays: rays in the scene frame.
        maps: what the method rendered for them.
    """
    response = neilf.facts.response
    return {
        "rgb": apply_response(maps.rgb, response),
        "rgb_volume": apply_response(maps.rgb_volume, response),
        "base_color": maps.base_color,
        "roughness": maps.roughness,
        "metallic": maps.metallic,
        "incident_light": mean_incident_light(neilf, rays, maps),
        "normal": maps.normal,
        # The name and the range under which `ns-export` looks for normals. Rounding can exceed 1.
        "normals": (0.5 * (maps.normal + 1.0)).clamp(0, 1),
        "depth": maps.depth,
        "accumulation": maps.opacity,
    }


@torch.no_grad()
def mean_incident_light(neilf: NeilfModel, rays: RayBatch, maps: Maps) -> Float[Tensor, "N 3"]:
    """Irradiance divided by π at the hits of rays: the cosine-weighted mean of the incident radiance."""
    light = torch.zeros_like(maps.rgb)
    # Roughness is 0 for rays without a hit, and for all rays before material is trained.
    rows = torch.nonzero(maps.roughness[:, 0])[:, 0]
    if not len(rows):
        return light
    normal = maps.normal[rows]
    position = rays.origins[rows] + maps.depth[rows] * rays.directions[rows]
    # The pdf of the cosine sampler cancels the cosine, so the estimate is a plain mean.
    drawn = combine([(cosine(normal), neilf.config.shading.train_samples)], stochastic=False)
    light[rows] = neilf.incident_light(position, drawn.wi).mean(dim=1)
    return light
