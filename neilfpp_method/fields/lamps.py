"""L for light from close by: a few small lamps, whose direction and strength depend on the place."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from neilfpp_method.shading.frame import dot, safe_normalize
from neilfpp_method.structures import IncidentSamples

__all__ = ["LampRays", "Lamps"]


@dataclass(frozen=True)
class LampRays:
    """From N points towards K lamps: direction, distance, and the solid angle of each lamp."""

    wi: Float[Tensor, "N K 3"]
    distance: Float[Tensor, "N K"]
    solid_angle: Float[Tensor, "N K"]

    def samples(self) -> IncidentSamples:
        """One direction per lamp as samples of an estimator: the mean over K of f/pdf is the sum over the lamps."""
        return IncidentSamples(self.wi, 1 / (self.wi.shape[1] * self.solid_angle))


class Lamps(nn.Module):
    """Spheres of one radius that send the same light in all directions; as many as are lit come first.

    Lamps are no parameters: they are found together with the environment map, by `light_fit`.

    Args:
        most: how many there can be.
        radius: of each, scene units. Only how sharp their reflections are depends on it.
    """

    def __init__(self, most: int, radius: float) -> None:
        super().__init__()
        self.radius = radius
        self.lit = 0
        self.register_buffer("position", torch.zeros(most, 3))
        self.register_buffer("intensity", torch.zeros(most, 3))

    @torch.no_grad()
    def place(self, position: Float[Tensor, "K 3"], intensity: Float[Tensor, "K 3"]) -> None:
        """These lamps and no others, the first of them where they are too many; intensity is power per solid angle."""
        self.lit = min(len(position), len(self.position))
        self.position.zero_()[: self.lit] = position[: self.lit]
        self.intensity.zero_()[: self.lit] = intensity[: self.lit]

    def rays_from(self, x: Float[Tensor, "N 3"]) -> LampRays:
        """Towards the middle of each lit lamp."""
        return rays_towards(x, self.position[: self.lit], self.radius)

    def radiance(self) -> Float[Tensor, "K 3"]:
        """What a lit lamp shows of itself: intensity over the area of its disc."""
        return self.intensity[: self.lit] / (math.pi * self.radius**2)

    def seen(self, x: Float[Tensor, "N 3"], wi: Float[Tensor, "N S 3"], before: Float[Tensor, "N S"]) -> Float[Tensor, "N S 3"]:
        """Radiance of the lamps that directions meet nearer than a distance; where they overlap, all of them."""
        total = torch.zeros_like(wi)
        towards = self.position[: self.lit] - x[:, None]
        for offset, radiance in zip(towards.unbind(1), self.radiance(), strict=True):
            along = dot(wi, offset)
            miss = offset.square().sum(-1)[:, None] - along.square()
            met = (along > 0) & (miss < self.radius**2) & (along < before)
            total = total + met[..., None] * radiance
        return total

    def get_extra_state(self) -> dict[str, int]:
        """How many are lit, for checkpoints."""
        return {"lit": self.lit}

    def set_extra_state(self, state: dict[str, int]) -> None:
        """The inverse of `get_extra_state`."""
        self.lit = state["lit"]


def rays_towards(x: Float[Tensor, "N 3"], position: Float[Tensor, "K 3"], radius: float) -> LampRays:
    """Towards spheres at `position`; from within two radii of its middle, a lamp looks as from two radii away."""
    offset = position - x[:, None]
    distance = offset.square().sum(-1).clamp_min((2 * radius) ** 2).sqrt()
    return LampRays(safe_normalize(offset), distance, math.pi * radius**2 / distance.square())
