"""Empty space that a ray may skip: a coarse grid of the distance field says where no surface can be.

The grid knows the field at its vertices, and how fast it changes between them. Within L · r of a place where
it is known to be v, a field whose slope is at most L lies in v ± L · r: what is clear by that measure is
skipped, and a plate thinner than a cell is not. The field moves while it trains. So every use asks it once
per ray in the part that would be skipped; where one answer breaks the promise no ray skips anything, and the
grid is soon sampled anew.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from neilfpp_method.structures import RayBatch
from neilfpp_method.volume.distance_grid import cell_size, look_up, sample_grid
from neilfpp_method.volume.intersect import Interval

__all__ = ["EmptySpace", "Span"]

LOOK_UPS = 128
"""Places along a ray at which the grid is read."""
RESOLUTION = 64
"""Vertices along an edge of the grid."""
MARGIN = 1.1
"""The field's slope over the largest between neighbouring vertices."""
MISSED = 0.01
"""Most opacity that the density of skipped space may have."""
HARDLY_MISSED = 1e-3
"""The same in pictures: a quarter of a level of 8 bits."""
OPAQUE = 8.0
"""Optical depth behind which nothing is seen."""
MIN_LIFE, MAX_LIFE = 20, 100
"""Steps in which the field moves before the grid may, and must, be sampled anew."""


@dataclass(frozen=True)
class Span:
    """Which rays have a part that is taken, and where it starts and ends; the whole ray without one."""

    some: Bool[Tensor, " N"]
    interval: Interval


class EmptySpace(nn.Module):
    """The grid and its age, which are kept in checkpoints: a resumed run must skip the very same space.

    Args:
        radius: of the scene sphere.
    """

    def __init__(self, radius: float) -> None:
        super().__init__()
        self.radius = radius
        self.register_buffer("distance", torch.zeros(RESOLUTION, RESOLUTION, RESOLUTION))
        self.register_buffer("slope", torch.zeros(()))
        self.age: int | None = None

    def moved(self) -> None:
        """The field has taken a step."""
        if self.age is not None:
            self.age += 1

    @torch.no_grad()
    def narrow(
        self,
        sdf: Callable[[Float[Tensor, "P 3"]], Float[Tensor, " P"]],
        rays: RayBatch,
        interval: Interval,
        beta: Float[Tensor, ""],
    ) -> Interval:
        """The part of each ray outside which the density of scale `beta` neither absorbs nor can be seen.

        Costs one query of the field per ray. A ray that is empty all along keeps its whole interval. On a CPU
        a broken promise is noticed at once; elsewhere nobody waits for the answer, and the age of the grid
        alone decides.
        """
        self._renew(sdf)
        edges, clearance = self._edges(interval), self._clearance(beta, MISSED)
        empty, opaque = self._known(rays, edges, clearance, beta)
        if rays.origins.device.type == "cpu" and not self._holds(sdf, rays, edges, empty, clearance):
            if self.age is not None and self.age >= MIN_LIFE:
                self.age = None  # the next use samples it
            return interval
        return _span(edges, ~empty & ~opaque, interval).interval

    @torch.no_grad()
    def may_show(
        self,
        sdf: Callable[[Float[Tensor, "P 3"]], Float[Tensor, " P"]],
        rays: RayBatch,
        interval: Interval,
        beta: Float[Tensor, ""],
    ) -> Span:
        """Which rays may show anything, and the part of each within which they do; a fixed field.

        The grid must be that of the field as it is: it is sampled by the first who asks, and no promise is
        tested. What is left out has an opacity of at most `HARDLY_MISSED`.
        """
        self._renew(sdf)
        edges = self._edges(interval)
        empty, opaque = self._known(rays, edges, self._clearance(beta, HARDLY_MISSED), beta)
        return _span(edges, ~empty & ~opaque, interval)

    @torch.no_grad()
    def may_meet(
        self,
        sdf: Callable[[Float[Tensor, "P 3"]], Float[Tensor, " P"]],
        rays: RayBatch,
        interval: Interval,
        beta: Float[Tensor, ""],
    ) -> Bool[Tensor, " N"]:
        """Which rays may come down on a surface, for rays that leave one: their start is never clear.

        A ray that enters a surface does so where the distance falls. So a ray may meet one if somewhere the
        grid's distance falls along it in a part that is not empty for sure. Between vertices the grid knows a
        falling distance less well than a small one: a surface within a cell or two of the start may be
        overlooked. Costs look-ups alone.
        """
        self._renew(sdf)
        edges = self._edges(interval)
        distance = self._read(rays, edges)
        empty = distance - self._doubt(edges) > self._clearance(beta, MISSED)
        return ((distance.diff(dim=-1) < 0.0) & ~empty[:, 1:]).any(-1)

    def _renew(self, sdf: Callable[[Float[Tensor, "P 3"]], Float[Tensor, " P"]]) -> None:
        if self.age is None or self.age >= MAX_LIFE:
            self._sample(sdf)

    def _sample(self, sdf: Callable[[Float[Tensor, "P 3"]], Float[Tensor, " P"]]) -> None:
        self.distance.copy_(sample_grid(sdf, self.radius, RESOLUTION, self.distance))
        steps = torch.stack([self.distance.diff(dim=axis).abs().amax() for axis in range(3)])
        self.slope.copy_(MARGIN * steps.amax() / cell_size(self.distance, self.radius))
        self.age = 0

    def _known(
        self,
        rays: RayBatch,
        edges: Float[Tensor, "N E"],
        clearance: Float[Tensor, ""],
        beta: Float[Tensor, ""],
    ) -> tuple[Bool[Tensor, "N K"], Bool[Tensor, "N K"]]:
        """Which parts of the rays are empty for sure, and which lie for sure behind what is opaque."""
        width, distance, doubt = edges.diff(dim=-1), self._read(rays, edges), self._doubt(edges)
        # Inside, the density is at least half of 1/β.
        depth = ((distance + doubt < 0.0) * width / (2.0 * beta)).cumsum(dim=-1)
        return distance - doubt > clearance, depth - width / (2.0 * beta) > OPAQUE

    def _edges(self, interval: Interval) -> Float[Tensor, "N E"]:
        """The ends of the parts of each ray."""
        share = torch.linspace(0, 1, LOOK_UPS + 1, device=self.distance.device, dtype=interval.near.dtype)
        return torch.lerp(interval.near[:, None], interval.far[:, None], share)

    def _read(self, rays: RayBatch, edges: Float[Tensor, "N E"]) -> Float[Tensor, "N K"]:
        """The grid's distance in the middle of each part."""
        middle = 0.5 * (edges[:, :-1] + edges[:, 1:])
        points = rays.origins[:, None] + middle[..., None] * rays.directions[:, None]
        return look_up(self.distance, self.radius, points.reshape(-1, 3)).view(middle.shape)

    def _doubt(self, edges: Float[Tensor, "N E"]) -> Float[Tensor, "N K"]:
        """How far the field in a part may be from what the grid says in its middle."""
        # A weighted mean of a cell's vertices is off by at most the slope times half of its diagonal.
        reach = 0.5 * math.sqrt(3.0) * cell_size(self.distance, self.radius)
        return self.slope * (0.5 * edges.diff(dim=-1) + reach)

    def _clearance(self, beta: Float[Tensor, ""], missed: float) -> Float[Tensor, ""]:
        """The distance from which a density of scale β adds up to at most `missed` along a ray."""
        return beta * math.log(self.radius / missed) - beta * beta.log()  # e^(−G/β) · 2 radius / 2β ≤ missed

    def _holds(
        self,
        sdf: Callable[[Float[Tensor, "P 3"]], Float[Tensor, " P"]],
        rays: RayBatch,
        edges: Float[Tensor, "N E"],
        empty: Bool[Tensor, "N K"],
        clearance: Float[Tensor, ""],
    ) -> bool:
        """Whether the field is clear at one random place of each ray, where the grid says that it is."""
        at = torch.rand_like(edges[:, :1])
        part = (at * LOOK_UPS).long().clamp_max(LOOK_UPS - 1)
        distance = torch.lerp(edges[:, :1], edges[:, -1:], at)
        found = sdf(rays.origins + distance * rays.directions)
        return not bool((empty.gather(-1, part)[:, 0] & (found <= clearance)).any())

    def get_extra_state(self) -> dict[str, int | None]:
        """The age, for checkpoints."""
        return {"age": self.age}

    def set_extra_state(self, state: dict[str, int | None]) -> None:
        """The inverse of `get_extra_state`."""
        self.age = state["age"]


def _span(edges: Float[Tensor, "N E"], taken: Bool[Tensor, "N K"], interval: Interval) -> Span:
    first = taken.to(torch.int8).argmax(dim=-1, keepdim=True)
    last = LOOK_UPS - taken.flip(-1).to(torch.int8).argmax(dim=-1, keepdim=True)
    some = taken.any(-1)
    return Span(
        some,
        Interval(
            torch.where(some, edges.gather(-1, first)[:, 0], interval.near),
            torch.where(some, edges.gather(-1, last)[:, 0], interval.far),
        ),
    )
