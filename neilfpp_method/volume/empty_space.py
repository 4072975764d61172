"""Empty space that rays may skip, according to a coarse grid of the distance field.

The grid holds the field at its vertices and a bound L on its slope near each of them. Within a distance r of
a point with value v the field lies in v ± L · r. Parts of rays that this bound shows to be empty are skipped;
a plate thinner than a cell is not skipped.

The field changes while it is trained. So every use checks the field itself at one random point per ray in the
part to be skipped. If one of them is not empty, no ray skips anything, and the grid is soon sampled again.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn.functional import max_pool3d

from neilfpp_method.structures import RayBatch
from neilfpp_method.volume.distance_grid import SignedDistance, cell_size, look_up, sample_grid
from neilfpp_method.volume.intersect import Interval

__all__ = ["EmptySpace", "EvaluationSpace", "Span", "evaluation_space"]

RAY_PARTS = 128
"""Number of parts of a ray; the grid is read once in each."""
RESOLUTION = 64
"""Vertices along an edge of the grid."""
MARGIN = 1.1
"""Ratio of the bound on the slope to the largest slope between neighbouring vertices nearby."""
NEARBY = 1
"""Number of cells in each direction from an edge of the grid in which its slope counts. A part of a ray is
half as long as a cell, so the bound at its centre holds in all of it.
"""
MAX_OPACITY_IN_TRAINING = 0.01
"""Largest opacity of skipped space in training."""
MAX_OPACITY_IN_EVALUATION = 1e-3
"""Largest opacity of skipped space in evaluation: a quarter of an 8-bit level."""
OPAQUE_DEPTH = 8.0
"""Optical depth behind which nothing is visible."""
MIN_LIFE, MAX_LIFE = 20, 100
"""Training steps after which the grid may, and must, be sampled again."""


@dataclass(frozen=True)
class Span:
    """Which rays have a part to be sampled, and the interval of this part; the whole ray if there is none."""

    has_part: Bool[Tensor, " N"]
    interval: Interval


@dataclass(frozen=True)
class _Parts:
    """The equal parts of rays: which are certainly empty, and which are certainly behind an opaque part."""

    empty: Bool[Tensor, "N K"]
    hidden: Bool[Tensor, "N K"]

    @property
    def may_show(self) -> Bool[Tensor, "N K"]:
        """Which parts may show a surface."""
        return ~self.empty & ~self.hidden


@dataclass(frozen=True)
class _Reading:
    """The field in each part of rays: the grid's value at its centre, and the largest deviation from that."""

    distance: Float[Tensor, "N K"]
    deviation: Float[Tensor, "N K"]


class EmptySpace(nn.Module):
    """The grid and its age. Both are in checkpoints, so that a resumed run skips the same space.

    Args:
        radius: radius of the scene sphere, scene units.
    """

    def __init__(self, radius: float) -> None:
        super().__init__()
        self.radius = radius
        self.register_buffer("distance", torch.zeros(RESOLUTION, RESOLUTION, RESOLUTION))
        self.register_buffer("slope", torch.ones(RESOLUTION, RESOLUTION, RESOLUTION))
        self.age: int | None = None

    def moved(self) -> None:
        """Record that a training step has changed the field."""
        if self.age is not None:
            self.age += 1

    @torch.no_grad()
    def narrow(
        self,
        sdf: SignedDistance,
        rays: RayBatch,
        interval: Interval,
        beta: Float[Tensor, ""],
    ) -> Interval:
        """The part of each ray outside of which the density of scale `beta` is negligible or occluded.

        It costs one query of the field per ray, on a CPU. An empty ray keeps its whole interval. On other
        devices the check would have to wait for the device, so only the age of the grid decides when it is
        sampled again.
        """
        self._renew(sdf)
        edges, clearance = self._edges(interval), self._clearance(beta, MAX_OPACITY_IN_TRAINING)
        parts = self._parts(rays, edges, clearance, beta)
        can_check = rays.origins.device.type == "cpu"
        if can_check and not self._is_confirmed(sdf, rays, edges, parts.empty, clearance):
            if self.age is not None and self.age >= MIN_LIFE:
                # Sample the grid again at its next use.
                self.age = None
            return interval
        return _span(edges, parts.may_show, interval).interval

    @torch.no_grad()
    def may_show(
        self,
        sdf: SignedDistance,
        rays: RayBatch,
        interval: Interval,
        beta: Float[Tensor, ""],
    ) -> Span:
        """Which rays may show a surface, and the part of each ray that is visible, for a fixed field.

        The grid must belong to the current field, as the field itself is not checked; it is sampled at first
        use. The parts that are left out have an opacity of at most `MAX_OPACITY_IN_EVALUATION`.
        """
        self._renew(sdf)
        edges = self._edges(interval)
        parts = self._parts(rays, edges, self._clearance(beta, MAX_OPACITY_IN_EVALUATION), beta)
        return _span(edges, parts.may_show, interval)

    @torch.no_grad()
    def may_hit(
        self,
        sdf: SignedDistance,
        rays: RayBatch,
        interval: Interval,
        beta: Float[Tensor, ""],
    ) -> Bool[Tensor, " N"]:
        """Which rays may hit a surface, for rays that start at a surface.

        The start of such a ray is never empty, so `narrow` would skip nothing. The distance decreases where a
        ray approaches a surface, however. So a ray may hit if the distance decreases along it in a part that
        is not certainly empty. This is less reliable than `narrow`: a surface within one or two cells of the
        start may be missed. It costs only grid look-ups.
        """
        self._renew(sdf)
        edges = self._edges(interval)
        read = self._read(rays, edges)
        empty = read.distance - read.deviation > self._clearance(beta, MAX_OPACITY_IN_TRAINING)
        return ((read.distance.diff(dim=-1) < 0.0) & ~empty[:, 1:]).any(-1)

    def _renew(self, sdf: SignedDistance) -> None:
        if self.age is None or self.age >= MAX_LIFE:
            self._sample(sdf)

    def _sample(self, sdf: SignedDistance) -> None:
        self.distance.copy_(sample_grid(sdf, self.radius, RESOLUTION, self.distance))
        self.slope.copy_(_slope_nearby(self.distance, cell_size(self.distance, self.radius)))
        self.age = 0

    def _parts(
        self,
        rays: RayBatch,
        edges: Float[Tensor, "N E"],
        clearance: Float[Tensor, ""],
        beta: Float[Tensor, ""],
    ) -> _Parts:
        width, read = edges.diff(dim=-1), self._read(rays, edges)
        # Inside, the isotropic density is at least 1 / (2 β). The opacity of the entering density grows with
        # the depth, not with the path. Few rays stay within a few β of the surface for so long, and they lose
        # an opacity of 2 % at most (tests/volume/test_empty_space.py).
        inside = read.distance + read.deviation < 0.0
        depth = (inside * width / (2.0 * beta)).cumsum(dim=-1)
        empty = read.distance - read.deviation > clearance
        return _Parts(empty, depth - width / (2.0 * beta) > OPAQUE_DEPTH)

    def _edges(self, interval: Interval) -> Float[Tensor, "N E"]:
        """The ends of the equal parts of each ray."""
        share = torch.linspace(0, 1, RAY_PARTS + 1, device=self.distance.device, dtype=interval.near.dtype)
        return torch.lerp(interval.near[:, None], interval.far[:, None], share)

    def _read(self, rays: RayBatch, edges: Float[Tensor, "N E"]) -> _Reading:
        """Read the grid at the centre of each part."""
        middle = 0.5 * (edges[:, :-1] + edges[:, 1:])
        points = (rays.origins[:, None] + middle[..., None] * rays.directions[:, None]).reshape(-1, 3)
        distance, slope = look_up(torch.stack([self.distance, self.slope]), self.radius, points)
        # The error of interpolation in a cell is at most the slope times half of the cell's diagonal.
        reach = 0.5 * math.sqrt(3.0) * cell_size(self.distance, self.radius)
        deviation = slope.view(middle.shape) * (0.5 * edges.diff(dim=-1) + reach)
        return _Reading(distance.view(middle.shape), deviation)

    def _clearance(self, beta: Float[Tensor, ""], missed: float) -> Float[Tensor, ""]:
        """Distance from the surface beyond which a ray has an opacity of at most `missed`."""
        # Solves e^(−G/β) · 2 radius / (2β) ≤ missed for G.
        return beta * math.log(self.radius / missed) - beta * beta.log()

    def _is_confirmed(
        self,
        sdf: SignedDistance,
        rays: RayBatch,
        edges: Float[Tensor, "N E"],
        empty: Bool[Tensor, "N K"],
        clearance: Float[Tensor, ""],
    ) -> bool:
        """Whether the field itself is empty at one random point of each ray, if the grid says so there."""
        at = torch.rand_like(edges[:, :1])
        part = (at * RAY_PARTS).long().clamp_max(RAY_PARTS - 1)
        distance = torch.lerp(edges[:, :1], edges[:, -1:], at)
        actual = sdf(rays.origins + distance * rays.directions)
        return not bool((empty.gather(-1, part)[:, 0] & (actual <= clearance)).any())

    def get_extra_state(self) -> dict[str, int | None]:
        """The age of the grid, for checkpoints."""
        return {"age": self.age}

    def set_extra_state(self, state: dict[str, int | None]) -> None:
        """Restore what `get_extra_state` returned."""
        self.age = state["age"]


def _slope_nearby(distance: Float[Tensor, "R R R"], cell: float) -> Float[Tensor, "R R R"]:
    """A bound on the slope of the field near each vertex: of the differences along the edges, at least 1."""
    squared = torch.zeros_like(distance)
    for axis in range(3):
        step = distance.diff(dim=axis).abs() / cell
        before = torch.cat([step.narrow(axis, 0, 1), step], axis)
        after = torch.cat([step, step.narrow(axis, -1, 1)], axis)
        squared += torch.maximum(before, after).square()
    largest = max_pool3d(squared.sqrt()[None], 2 * NEARBY + 1, stride=1, padding=NEARBY)[0]
    return MARGIN * largest.clamp_min(1.0)


def _span(edges: Float[Tensor, "N E"], taken: Bool[Tensor, "N K"], interval: Interval) -> Span:
    first = taken.to(torch.int8).argmax(dim=-1, keepdim=True)
    last = RAY_PARTS - taken.flip(-1).to(torch.int8).argmax(dim=-1, keepdim=True)
    has_part = taken.any(-1)
    return Span(
        has_part,
        Interval(
            torch.where(has_part, edges.gather(-1, first)[:, 0], interval.near),
            torch.where(has_part, edges.gather(-1, last)[:, 0], interval.far),
        ),
    )


@dataclass(frozen=True)
class EvaluationSpace:
    """Empty space of a G that is not being trained, and the versions of the parameters that G had then.

    The versions show that weights were loaded. They do not show every training step (`hosts.volsdf`).
    """

    versions: list[tuple[int, int]]
    space: EmptySpace


def evaluation_space(known: EvaluationSpace | None, field: nn.Module, radius: float) -> EvaluationSpace:
    """`known` if the parameters of the field still have its versions, else a new one, to be sampled."""
    parameters = list(field.parameters())
    versions = [(id(p), p._version) for p in parameters]
    if known is not None and known.versions == versions:
        return known
    return EvaluationSpace(versions, EmptySpace(radius).to(parameters[0]))
