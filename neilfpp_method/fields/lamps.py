"""L for near light: a few small lamps, whose direction and irradiance depend on the surface point."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from neilfpp_method.shading.frame import dot, safe_normalize
from neilfpp_method.structures import IncidentSamples, Indexable, SceneTracer

__all__ = ["LampPlaces", "LampRays", "Lamps", "emission", "rays_towards"]


@dataclass(frozen=True)
class LampPlaces(Indexable):
    """Positions of M lamps, and their unit axes; a zero axis means an isotropic lamp (see `Lamps`)."""

    position: Float[Tensor, "M 3"]
    axis: Float[Tensor, "M 3"]


@dataclass(frozen=True)
class LampRays:
    """Rays from N points towards K lamps.

    Attributes:
        wi: unit directions from the points to the lamps.
        distance: distances to the centres of the lamps, scene units.
        solid_angle: solid angles of the lamps as seen from the points, steradians.
        emission: share of its intensity that a lamp sends towards the point, in [0, 1].
    """

    wi: Float[Tensor, "N K 3"]
    distance: Float[Tensor, "N K"]
    solid_angle: Float[Tensor, "N K"]
    emission: Float[Tensor, "N K"]

    def samples(self) -> IncidentSamples:
        """One direction per lamp as samples: the mean of f/pdf over K is the sum over the lamps."""
        return IncidentSamples(self.wi, 1 / (self.wi.shape[1] * self.solid_angle))

    def visibility(self, x: Float[Tensor, "N 3"], scene: SceneTracer | None) -> Bool[Tensor, "N K"]:
        """Whether a shadow ray from x reaches the centre of a lamp; without a scene, nothing occludes it.

        Args:
            x: the points from which the rays start.
            scene: traces the shadow rays; None if inter-reflection is off.
        """
        if scene is None:
            return torch.ones_like(self.distance, dtype=torch.bool)
        return scene(x, self.wi).distance >= self.distance


class Lamps(nn.Module):
    """A set of spherical lamps of one radius, the first `count` of which emit light.

    A lamp with a zero axis is isotropic, like a bulb. A lamp with a unit axis has the intensity I cos θ at an
    angle θ from its axis, and none backwards, like a small window or a flat panel. Lamps are buffers, not
    parameters: they are solved for together with the environment map (`lighting`).

    Args:
        capacity: maximum number of lamps.
        radius: radius of each lamp, scene units. It only affects the sharpness of reflections.
    """

    def __init__(self, capacity: int, radius: float) -> None:
        super().__init__()
        self.radius = radius
        self.count = 0
        self.register_buffer("position", torch.zeros(capacity, 3))
        self.register_buffer("axis", torch.zeros(capacity, 3))
        self.register_buffer("intensity", torch.zeros(capacity, 3))

    @torch.no_grad()
    def place(
        self,
        position: Float[Tensor, "K 3"],
        intensity: Float[Tensor, "K 3"],
        axis: Float[Tensor, "K 3"] | None = None,
    ) -> None:
        """Replace all lamps by these, or by the first `capacity` of them.

        Args:
            position: centres, scene frame.
            intensity: power per solid angle, on the axis if there is one.
            axis: unit axes, or zeros; if None, all lamps are isotropic.
        """
        self.count = min(len(position), len(self.position))
        self.position.zero_()[: self.count] = position[: self.count]
        self.axis.zero_()
        if axis is not None:
            self.axis[: self.count] = axis[: self.count]
        self.intensity.zero_()[: self.count] = intensity[: self.count]

    def switch_off(self) -> None:
        """Remove all lamps."""
        self.place(self.position[:0], self.intensity[:0])

    @property
    def lit_places(self) -> LampPlaces:
        """Positions and axes of the lit lamps."""
        return LampPlaces(self.position[: self.count], self.axis[: self.count])

    @property
    def lit_intensity(self) -> Float[Tensor, "K 3"]:
        """Intensities of the lit lamps."""
        return self.intensity[: self.count]

    def rays_from(self, x: Float[Tensor, "N 3"]) -> LampRays:
        """Rays from points towards the centre of each lit lamp."""
        return rays_towards(x, self.position[: self.count], self.axis[: self.count], self.radius)

    def radiance(self) -> Float[Tensor, "K 3"]:
        """Radiance of the lit lamps on their axes: intensity over the area of the disc."""
        return self.lit_intensity / (math.pi * self.radius**2)

    def arriving(self, rays: LampRays) -> Float[Tensor, "N K 3"]:
        """Radiance along rays from the lit lamps, without occlusion."""
        return rays.emission[..., None] * self.radiance()

    def radiance_along(
        self, x: Float[Tensor, "N 3"], wi: Float[Tensor, "N S 3"], before: Float[Tensor, "N S"]
    ) -> Float[Tensor, "N S 3"]:
        """Radiance of the lamps that directions hit closer than `before`; overlapping lamps add up."""
        total = torch.zeros_like(wi)
        towards = self.position[: self.count] - x[:, None]
        for offset, axis, radiance in zip(
            towards.unbind(1), self.axis[: self.count], self.radiance(), strict=True
        ):
            along = dot(wi, offset)
            miss = offset.square().sum(-1)[:, None] - along.square()
            hit = (along > 0) & (miss < self.radius**2) & (along < before)
            total = total + (hit * emission(wi, axis))[..., None] * radiance
        return total

    def get_extra_state(self) -> dict[str, int]:
        """Number of lit lamps, for checkpoints."""
        return {"count": self.count}

    def set_extra_state(self, state: dict[str, int]) -> None:
        """Restore what `get_extra_state` returned."""
        self.count = state["count"]


def rays_towards(
    x: Float[Tensor, "N 3"], position: Float[Tensor, "K 3"], axis: Float[Tensor, "K 3"], radius: float
) -> LampRays:
    """Rays from points towards lamps. The distance is at least two radii, which bounds the solid angle."""
    offset = position - x[:, None]
    distance = offset.square().sum(-1).clamp_min((2 * radius) ** 2).sqrt()
    wi = safe_normalize(offset)
    return LampRays(wi, distance, math.pi * radius**2 / distance.square(), emission(wi, axis))


def emission(wi: Float[Tensor, "*B 3"], axis: Float[Tensor, "*A 3"]) -> Float[Tensor, "*B"]:
    """Share of its intensity that a lamp with this axis sends along −wi; `axis` broadcasts to `wi`."""
    is_isotropic = axis.square().sum(-1) == 0
    return torch.where(is_isotropic, 1.0, (-(wi * axis).sum(-1)).clamp_min(0))
