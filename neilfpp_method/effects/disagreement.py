"""Evidence for the joint stage: how much worse light and material explain pixels than R does.

R knows no physics and paints what cameras saw, as far as its surface lets it. Where shading on the same
surface comes as close, there is nothing that moving the surface could mend.
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

__all__ = ["WORTH", "ShownSurface", "shading_disagreement"]

WORTH = 0.01
"""Relative error that shading must have beyond that of R."""
AT_ONCE = 256
"""Points that are shaded together; bounds the memory."""


@dataclass(frozen=True)
class ShownSurface:
    """Surface points with what an image holds of them, scene frame, and the radiance that R has there."""

    observed: Observed
    radiance: Float[Tensor, "P 3"]


@torch.no_grad()
def shading_disagreement(model: NeilfModel, seen: ShownSurface) -> Measurement:
    """The relative error of shaded points beyond that of R, in the mean; the model is in evaluation mode."""
    what = "error of shading beyond that of R"
    response, unit = model.facts.response, model.units.physical

    def error(radiance: Float[Tensor, "N 3"], pixel: Float[Tensor, "N 3"]) -> Float[Tensor, " N"]:
        off = (apply_response(radiance, response) - pixel) / error_unit(pixel, response, unit)
        return off.abs().clamp_max(1).mean(-1)

    beyond = []
    for start in range(0, len(seen.radiance), AT_ONCE):
        part, radiance = seen.observed[start : start + AT_ONCE], seen.radiance[start : start + AT_ONCE]
        material = model.materials(part.position)
        samples = model.config.shading.eval_samples
        shaded = model.shade(part.position, part.normal, part.wo, material, samples).color
        beyond.append(error(shaded, part.pixel) - error(radiance, part.pixel))
    return mean_of(torch.cat(beyond) if beyond else seen.radiance[:, 0], what, WORTH)
