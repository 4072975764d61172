"""L for light from close by: a few small lamps, whose direction and strength depend on the place."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from neilfpp_method.shading.frame import dot, safe_normalize
from neilfpp_method.structures import IncidentSamples, Indexable

__all__ = ["LampPlaces", "LampRays", "Lamps", "rays_towards"]


@dataclass(frozen=True)
class LampPlaces(Indexable):
    """Where M lamps are, and which way they send: a unit axis, or zero for all ways alike (`Lamps`)."""

    position: Float[Tensor, "M 3"]
    axis: Float[Tensor, "M 3"]


@dataclass(frozen=True)
class LampRays:
    """From N points towards K lamps: direction, distance, the solid angle of each lamp, and the share of its
    intensity that it sends this way.
    """

    wi: Float[Tensor, "N K 3"]
    distance: Float[Tensor, "N K"]
    solid_angle: Float[Tensor, "N K"]
    emission: Float[Tensor, "N K"]

    def samples(self) -> IncidentSamples:
        """One direction per lamp as an estimator's samples: the mean of f/pdf over K is the sum of lamps."""
        return IncidentSamples(self.wi, 1 / (self.wi.shape[1] * self.solid_angle))


class Lamps(nn.Module):
    """Spheres of one radius; as many as are lit come first.

    A lamp whose axis is zero sends the same light in all directions, as a bulb does; one with a unit axis
    sends I cos θ at an angle θ from it and nothing backwards, as a small window or a flat panel does. Lamps
    are no parameters: they are found together with the environment map (`lighting`).

    Args:
        most: how many there can be.
        radius: of each, scene units. Only how sharp their reflections are depends on it.
    """

    def __init__(self, most: int, radius: float) -> None:
        super().__init__()
        self.radius = radius
        self.lit = 0
        self.register_buffer("position", torch.zeros(most, 3))
        self.register_buffer("axis", torch.zeros(most, 3))
        self.register_buffer("intensity", torch.zeros(most, 3))

    @torch.no_grad()
    def place(
        self,
        position: Float[Tensor, "K 3"],
        intensity: Float[Tensor, "K 3"],
        axis: Float[Tensor, "K 3"] | None = None,
    ) -> None:
        """These lamps and no others, the first of them where they are too many.

        `intensity` is power per solid angle, on the axis where there is one; no `axis`: isotropic.
        """
        self.lit = min(len(position), len(self.position))
        self.position.zero_()[: self.lit] = position[: self.lit]
        self.axis.zero_()
        if axis is not None:
            self.axis[: self.lit] = axis[: self.lit]
        self.intensity.zero_()[: self.lit] = intensity[: self.lit]

    def rays_from(self, x: Float[Tensor, "N 3"]) -> LampRays:
        """Towards the middle of each lit lamp."""
        return rays_towards(x, self.position[: self.lit], self.axis[: self.lit], self.radius)

    def radiance(self) -> Float[Tensor, "K 3"]:
        """What a lit lamp shows of itself, on its axis: intensity over the area of its disc."""
        return self.intensity[: self.lit] / (math.pi * self.radius**2)

    def arriving(self, rays: LampRays) -> Float[Tensor, "N K 3"]:
        """Radiance along rays towards the lit lamps where nothing is in the way."""
        return rays.emission[..., None] * self.radiance()

    def met(
        self, x: Float[Tensor, "N 3"], wi: Float[Tensor, "N S 3"], before: Float[Tensor, "N S"]
    ) -> Float[Tensor, "N S 3"]:
        """Radiance of the lamps that directions meet nearer than a distance; overlapping lamps add."""
        total = torch.zeros_like(wi)
        towards = self.position[: self.lit] - x[:, None]
        for offset, axis, radiance in zip(
            towards.unbind(1), self.axis[: self.lit], self.radiance(), strict=True
        ):
            along = dot(wi, offset)
            miss = offset.square().sum(-1)[:, None] - along.square()
            hit = (along > 0) & (miss < self.radius**2) & (along < before)
            total = total + (hit * _emission(wi, axis))[..., None] * radiance
        return total

    def get_extra_state(self) -> dict[str, int]:
        """How many are lit, for checkpoints."""
        return {"lit": self.lit}

    def set_extra_state(self, state: dict[str, int]) -> None:
        """The inverse of `get_extra_state`."""
        self.lit = state["lit"]


def rays_towards(
    x: Float[Tensor, "N 3"], position: Float[Tensor, "K 3"], axis: Float[Tensor, "K 3"], radius: float
) -> LampRays:
    """Towards lamps at `position`; within two radii of its middle, a lamp looks as from two radii away."""
    offset = position - x[:, None]
    distance = offset.square().sum(-1).clamp_min((2 * radius) ** 2).sqrt()
    wi = safe_normalize(offset)
    return LampRays(wi, distance, math.pi * radius**2 / distance.square(), _emission(wi, axis))


def _emission(wi: Float[Tensor, "N K 3"], axis: Float[Tensor, "*K 3"]) -> Float[Tensor, "N K"]:
    """The share of its intensity that a lamp with this axis sends along −wi."""
    bare = axis.square().sum(-1) == 0
    return torch.where(bare, 1.0, (-(wi * axis).sum(-1)).clamp_min(0))
