"""Lamps for path tracing: spheres that are sampled by the solid angle that they subtend (`fields.lamps`)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from neilfpp_method.fields.lamps import Lamps, emission
from neilfpp_method.shading.color import luminance
from neilfpp_method.shading.frame import local_frame, safe_normalize

__all__ = ["LampHits", "LampSample", "Lamplight", "lamps_of_run"]

EVEN_SHARE = 0.05
"""Part of a lamp's selection probability that does not depend on its axis. The emission along the axis is
evaluated at the centre of the lamp only, so it can be 0 although part of the lamp is visible.
"""


@dataclass(frozen=True)
class LampSample:
    """Sampled directions towards lamps.

    Attributes:
        wi: unit directions.
        pdf: density per steradian, including the choice of the lamp; 0 if the sample is invalid.
        distance: distance to the surface of the lamp.
        radiance: radiance that arrives if the lamp is not occluded.
    """

    wi: Float[Tensor, "N 3"]
    pdf: Float[Tensor, " N"]
    distance: Float[Tensor, " N"]
    radiance: Float[Tensor, "N 3"]


@dataclass(frozen=True)
class LampHits:
    """Distance at which rays hit a lamp, infinite if they miss it, and the radiance from there."""

    distance: Float[Tensor, " N"]
    radiance: Float[Tensor, "N 3"]


@dataclass(frozen=True)
class Lamplight:
    """K spheres of equal radius that emit light.

    Attributes:
        position: centres, scene frame.
        axis: unit axes of panels, whose emission falls with the cosine to the axis; zero for bulbs, which
            emit equally in all directions.
        radiance: radiance along the axis.
        radius: radius, scene units.
    """

    position: Float[Tensor, "K 3"]
    axis: Float[Tensor, "K 3"]
    radiance: Float[Tensor, "K 3"]
    radius: float

    def sample(self, x: Float[Tensor, "N 3"], u: Float[Tensor, "N 3"]) -> LampSample:
        """Sample a lamp in proportion to its approximate contribution, and a direction within its cone.

        Args:
            x: points to illuminate, scene frame.
            u: random numbers in [0, 1).
        """
        probability = self._probabilities(x)
        last = len(self.position) - 1
        lamp = torch.searchsorted(probability.cumsum(-1), u[:, 2:].contiguous()).clamp_max(last)
        offset = self.position[lamp[:, 0]] - x
        one_minus_cosine = self._one_minus_cosine(offset)
        cosine = 1 - u[:, 0] * one_minus_cosine
        sine = ((1 - cosine) * (1 + cosine)).clamp_min(0).sqrt()
        azimuth = 2 * math.pi * u[:, 1]
        local = torch.stack((sine * azimuth.cos(), sine * azimuth.sin(), cosine), -1)
        wi = safe_normalize((local[:, :, None] * local_frame(safe_normalize(offset))).sum(1))
        pdf = probability.gather(1, lamp)[:, 0] * _cone_pdf(one_minus_cosine)
        hits = self._intersect(x, wi, lamp[:, 0])
        # Rounding can move a direction at the rim off the sphere; such a sample is invalid.
        return LampSample(wi, torch.where(hits.distance.isfinite(), pdf, 0.0), hits.distance, hits.radiance)

    def pdf(self, x: Float[Tensor, "N 3"], lamp: int) -> Float[Tensor, " N"]:
        """Density of `sample`, per steradian, at directions that hit a given lamp."""
        cone = _cone_pdf(self._one_minus_cosine(self.position[lamp] - x))
        return self._probabilities(x)[:, lamp] * cone

    def intersect(self, x: Float[Tensor, "N 3"], wi: Float[Tensor, "N 3"], lamp: int) -> LampHits:
        """Intersect rays with one lamp."""
        return self._intersect(x, wi, torch.full_like(x[:, 0], lamp, dtype=torch.int64))

    def _intersect(
        self, x: Float[Tensor, "N 3"], wi: Float[Tensor, "N 3"], lamp: Int[Tensor, " N"]
    ) -> LampHits:
        offset = self.position[lamp] - x
        along = (offset * wi).sum(-1)
        miss = (offset - along[:, None] * wi).square().sum(-1)
        outside = offset.square().sum(-1) > self.radius**2
        hit = outside & (along > 0) & (miss < self.radius**2)
        distance = torch.where(hit, along - (self.radius**2 - miss).clamp_min(0).sqrt(), torch.inf)
        return LampHits(distance, (hit * emission(wi, self.axis[lamp]))[:, None] * self.radiance[lamp])

    def _probabilities(self, x: Float[Tensor, "N 3"]) -> Float[Tensor, "N K"]:
        """Selection probability of each lamp at each point.

        It is proportional to luminance over squared distance, where a distance counts as at least the radius.
        """
        offset = self.position - x[:, None]
        share = EVEN_SHARE + (1 - EVEN_SHARE) * emission(safe_normalize(offset), self.axis)
        weight = luminance(self.radiance) * share / offset.square().sum(-1).clamp_min(self.radius**2)
        return weight / weight.sum(-1, keepdim=True)

    def _one_minus_cosine(self, offset: Float[Tensor, "N 3"]) -> Float[Tensor, " N"]:
        """1 − cos of the cone's half angle, accurate also for distant lamps; 0 inside of a lamp."""
        squared = offset.square().sum(-1)
        sine_squared = torch.where(squared > self.radius**2, self.radius**2 / squared, 0.0)
        return sine_squared / (1 + (1 - sine_squared).clamp_min(0).sqrt())


def lamps_of_run(lamps: Lamps | None) -> Lamplight | None:
    """The lit lamps of a run; None if there are none, or none emits light."""
    if lamps is None or not lamps.count or not lamps.radiance().any():
        return None
    used = slice(lamps.count)
    return Lamplight(
        lamps.position[used].clone(), lamps.axis[used].clone(), lamps.radiance().clone(), lamps.radius
    )


def _cone_pdf(one_minus_cosine: Float[Tensor, " N"]) -> Float[Tensor, " N"]:
    """Density of uniform directions in a cone, per steradian; 0 if the cone is empty."""
    empty = one_minus_cosine <= 0
    return torch.where(empty, 0.0, 1 / (2 * math.pi * torch.where(empty, 1.0, one_minus_cosine)))
