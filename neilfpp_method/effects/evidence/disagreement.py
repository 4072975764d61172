"""Evidence for the joint stage: how much larger the error of shaded pixels is than that of R.

R is not constrained by physics and reproduces the images as well as the surface permits. If shading on the
same surface is as accurate, moving the surface in the joint stage cannot improve it.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.effects.measurement import Measurement, mean_of
from neilfpp_method.lighting.objective import error_unit
from neilfpp_method.model import NeilfModel
from neilfpp_method.shading import apply_response
from neilfpp_method.structures import Observed

__all__ = ["THRESHOLD", "RenderedSurface", "shading_disagreement"]

THRESHOLD = 0.01
"""Excess of the relative error of shading over that of R above which the joint stage is worth its cost."""
POINTS_AT_ONCE = 256
"""Maximum number of points that are shaded at once; it bounds memory."""


@dataclass(frozen=True)
class RenderedSurface:
    """P surface points with their pixels.

    Attributes:
        observed: the points in the scene frame, and their pixels.
        radiance: the radiance that R renders for the same pixels.
    """

    observed: Observed
    radiance: Float[Tensor, "P 3"]


@torch.no_grad()
def shading_disagreement(model: NeilfModel, surface: RenderedSurface) -> Measurement:
    """Mean relative error of shaded pixels minus that of R.

    Args:
        model: the model, in evaluation mode.
        surface: surface points with their pixels and the radiance of R.
    """
    what = "error of shading in excess of that of R"
    response, unit = model.facts.response, model.units.physical

    def error(radiance: Float[Tensor, "N 3"], pixel: Float[Tensor, "N 3"]) -> Float[Tensor, " N"]:
        difference = apply_response(radiance, response) - pixel
        return (difference / error_unit(pixel, response, unit)).abs().clamp_max(1).mean(-1)

    excess = []
    for start in range(0, len(surface.radiance), POINTS_AT_ONCE):
        rows = slice(start, start + POINTS_AT_ONCE)
        part, radiance = surface.observed[rows], surface.radiance[rows]
        material = model.materials(part.position)
        samples = model.config.shading.eval_samples
        shaded = model.shade(part.position, part.normal, part.wo, material, samples).color
        excess.append(error(shaded, part.pixel) - error(radiance, part.pixel))
    return mean_of(torch.cat(excess) if excess else surface.radiance[:, 0], what, THRESHOLD)
