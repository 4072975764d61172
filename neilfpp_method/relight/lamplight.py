"""Lamps for path tracing: spheres that are sampled by the solid angle they cover (`fields.lamps`)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from neilfpp_method.fields.lamps import Lamps
from neilfpp_method.shading.color import luminance
from neilfpp_method.shading.frame import local_frame, safe_normalize

__all__ = ["LampSample", "Lamplight", "lamps_of_run"]

EVEN_SHARE = 0.05
"""Share of the lamps' probability without regard to axes: an axis is asked at a lamp's middle only."""


@dataclass(frozen=True)
class LampSample:
    """Unit directions towards a lamp each, their density per steradian (with the choice of the lamp), the
    distance of the lamp's surface, and the radiance that arrives where nothing is in the way. A density of 0:
    nothing was drawn."""

    wi: Float[Tensor, "N 3"]
    pdf: Float[Tensor, " N"]
    distance: Float[Tensor, " N"]
    radiance: Float[Tensor, "N 3"]


@dataclass(frozen=True)
class Lamplight:
    """K spheres of one radius. `radiance` is that on the `axis`; one of zeros: the same in all directions."""

    position: Float[Tensor, "K 3"]
    axis: Float[Tensor, "K 3"]
    radiance: Float[Tensor, "K 3"]
    radius: float

    def sample(self, x: Float[Tensor, "N 3"], u: Float[Tensor, "N 3"]) -> LampSample:
        """A direction within one lamp's cone, for numbers in [0, 1); lamps drawn by contribution."""
        chosen = self._shares(x)
        lamp = torch.searchsorted(chosen.cumsum(-1), u[:, 2:].contiguous()).clamp_max(len(self.position) - 1)
        offset = self.position[lamp[:, 0]] - x
        below_one = self._one_less_cosine(offset)
        cosine = 1 - u[:, 0] * below_one
        sine = ((1 - cosine) * (1 + cosine)).clamp_min(0).sqrt()
        azimuth = 2 * math.pi * u[:, 1]
        local = torch.stack((sine * azimuth.cos(), sine * azimuth.sin(), cosine), -1)
        wi = safe_normalize((local[:, :, None] * local_frame(safe_normalize(offset))).sum(1))
        pdf = chosen.gather(1, lamp)[:, 0] * _density(below_one)
        distance, radiance = self._met(x, wi, lamp[:, 0])
        # A direction at the rim that rounding has moved off the sphere brings nothing.
        return LampSample(wi, torch.where(distance.isfinite(), pdf, 0.0), distance, radiance)

    def pdf(self, x: Float[Tensor, "N 3"], lamp: int) -> Float[Tensor, " N"]:
        """Density of `sample` at directions that meet one of the lamps, per steradian, for this lamp."""
        return self._shares(x)[:, lamp] * _density(self._one_less_cosine(self.position[lamp] - x))

    def meet(self, x: Float[Tensor, "N 3"], wi: Float[Tensor, "N 3"], lamp: int) -> tuple[Tensor, Tensor]:
        """Distance (N,) at which directions meet a lamp, else infinite, and radiance (N, 3) from it."""
        return self._met(x, wi, torch.full_like(x[:, 0], lamp, dtype=torch.int64))

    def _met(
        self, x: Float[Tensor, "N 3"], wi: Float[Tensor, "N 3"], lamp: Int[Tensor, " N"]
    ) -> tuple[Tensor, Tensor]:
        offset = self.position[lamp] - x
        along = (offset * wi).sum(-1)
        miss = (offset - along[:, None] * wi).square().sum(-1)
        outside = offset.square().sum(-1) > self.radius**2
        hit = outside & (along > 0) & (miss < self.radius**2)
        distance = torch.where(hit, along - (self.radius**2 - miss).clamp_min(0).sqrt(), torch.inf)
        return distance, (hit * self._emission(wi, lamp))[:, None] * self.radiance[lamp]

    def _emission(self, wi: Float[Tensor, "*B 3"], lamp: Int[Tensor, "*L"]) -> Float[Tensor, "*B"]:
        axis = self.axis[lamp]
        bare = axis.square().sum(-1) == 0
        return torch.where(bare, 1.0, (-(wi * axis).sum(-1)).clamp_min(0))

    def _shares(self, x: Float[Tensor, "N 3"]) -> Float[Tensor, "N K"]:
        """The probability of each lamp at each point; all alike within a lamp's radius."""
        offset = self.position - x[:, None]
        every = torch.arange(len(self.position), device=x.device)
        sent = EVEN_SHARE + (1 - EVEN_SHARE) * self._emission(safe_normalize(offset), every)
        weight = luminance(self.radiance) * sent / offset.square().sum(-1).clamp_min(self.radius**2)
        return weight / weight.sum(-1, keepdim=True)

    def _one_less_cosine(self, offset: Float[Tensor, "N 3"]) -> Float[Tensor, " N"]:
        """1 − cos of the cone's half angle, with its digits also for a lamp far away; 0 within the lamp."""
        squared = offset.square().sum(-1)
        sine_squared = torch.where(squared > self.radius**2, self.radius**2 / squared, 0.0)
        return sine_squared / (1 + (1 - sine_squared).clamp_min(0).sqrt())


def lamps_of_run(lamps: Lamps | None) -> Lamplight | None:
    """The lamps that a run has lit; none where none is, or none sends light."""
    if lamps is None or not lamps.lit or not lamps.radiance().any():
        return None
    lit = slice(lamps.lit)
    return Lamplight(
        lamps.position[lit].clone(), lamps.axis[lit].clone(), lamps.radiance().clone(), lamps.radius
    )


def _density(one_less_cosine: Float[Tensor, " N"]) -> Float[Tensor, " N"]:
    """Of directions spread evenly over a cone; 0 where there is none."""
    inside = one_less_cosine <= 0
    return torch.where(inside, 0.0, 1 / (2 * math.pi * torch.where(inside, 1.0, one_less_cosine)))
