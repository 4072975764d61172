"""A traceable stand-in for the surface of a host without cheap tracing, built from training rays.

Hits of camera rays are oriented points; the newest of them are fused into a grid of distances
(`volume.fusion`) with the mean of the radiance that was seen there. Rays that leave a surface are
sphere-traced in the grid. So visibility, hard inter-reflection, an environment map and lamps work on any
host.

Before new rays go in, they are traced through what was known: that measures the error, and takes out points
that they pass through. A host that moves is followed in that way, a few dozen steps behind.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import Any, TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from neilfpp_method.lighting.ring import Ring
from neilfpp_method.shading.frame import safe_normalize
from neilfpp_method.structures import RayBatch, SceneLight, SurfaceHits
from neilfpp_method.volume.distance_grid import GridHits, look_up, trace_grid
from neilfpp_method.volume.fusion import FusedSurface, fuse, grid_normal, mean_at

__all__ = ["ProxyReport", "SurfaceProxy"]

POINTS = 32_768
"""Points that are kept: some four a cell on a surface of ten square units in a grid of 96³."""
EVERY = 64
"""Steps between two refreshes, once there have been as many; before that at steps 1, 2, 4, 8, …"""
ROUNDS, ROUND = 16, 512
"""Batches of rays rendered before the first step, from the first cameras towards their hits."""
SPREAD = 0.2
"""How far about a hit the look around aims, scene units: beside it is more of the surface."""
START = 0.75
"""Height above the grid's surface at which rays leave it, in cells; tracing ends at a quarter cell."""
APART = 2.0
"""A ray that goes this much further than the grid allows, in cells, passes through outdated points."""
CLEAR = 0.01
"""Largest opacity of a ray that meets nothing."""
GRAZING = 0.2
"""Least cosine between ray and normal in the last step onto the surface."""

log = logging.getLogger(__name__)

Radiance = Callable[[Float[Tensor, "N 3"], Float[Tensor, "N 3"]], Float[Tensor, "N 3"]]


@dataclass(frozen=True)
class ProxyReport:
    """How good the proxy is: measured on the rays that came since the last refresh, before they went in.

    Attributes:
        points: that it is made of.
        age: mean number of steps since they were seen.
        agreement: share of rays that meet a surface in both or in neither.
        error: median difference of the distances along rays that hit in both, scene units.
        error_95: the difference that 95 % of them stay below.
        cell: edge of a cell of the grid, scene units.
    """

    points: int
    age: float
    agreement: float
    error: float
    error_95: float
    cell: float

    def __str__(self) -> str:
        return (
            f"proxy of {self.points} points, seen {self.age:.0f} steps ago: {self.agreement:.1%} of rays "
            "agree with the host, "
            f"distances are off by {self.error:.4f} (95 %: {self.error_95:.4f}; a cell is {self.cell:.4f})"
        )


@dataclass(frozen=True)
class Looks:
    """Camera rays with what the host says of them: a distance, infinite for a miss."""

    rays: RayBatch
    distance: Float[Tensor, " N"]


class SurfaceProxy(nn.Module):
    """The newest points of a surface, and the grid made of them. A checkpoint holds the points alone.

    Args:
        radius: half the edge of the cube that holds the scene, scene units.
        resolution: vertices of the grid along an edge.
        hit_share: least concentration of a hit.
        radiance: what a point of the surface sends, where the host knows it without a ray; none: the mean of
            what was seen.
    """

    def __init__(
        self, radius: float, resolution: int, hit_share: float, radiance: Radiance | None = None
    ) -> None:
        super().__init__()
        self.radius = radius
        self.resolution = resolution
        self.hit_share = hit_share
        self.points = Ring(
            POINTS, 10
        )  # position, normal, radiance, the step that saw it; a normal of 0 is no point
        self.steps = 0
        self._radiance = radiance
        self._pending: list[tuple[RayBatch, SurfaceHits]] = []
        self._surface: FusedSurface | None = None
        self._report: ProxyReport | None = None

    @property
    def cell(self) -> float:
        """Edge of a cell of the grid, scene units."""
        return 2 * self.radius / (self.resolution - 1)

    # ---------------------------------------------------------------------------------------------- gathering

    @torch.no_grad()
    def observe(self, rays: RayBatch, hits: SurfaceHits) -> None:
        """A training step's camera rays and hits. Refreshes the grid when it is time."""
        self.steps += 1
        self._pending.append((rays.to(rays.origins.device), hits.detach()))
        if self.steps % EVERY == 0 or (self.steps < EVERY and self.steps & (self.steps - 1) == 0):
            self.refresh()

    @torch.no_grad()
    def look_around(
        self, render: Callable[[RayBatch], SurfaceHits], rays: RayBatch, hits: SurfaceHits
    ) -> None:
        """Before the first step, see enough of the surface to trace: from the first rays to their hits."""
        known = hits.position[hits.is_hit(self.hit_share)].detach()
        for _ in range(ROUNDS if len(known) else 0):
            origins = rays.origins[torch.randint(len(rays), (ROUND,), device=known.device)]
            aims = known[torch.randint(len(known), (ROUND,), device=known.device)]
            aims = aims + SPREAD * (2 * torch.rand_like(aims) - 1)
            look = RayBatch(origins, safe_normalize(aims - origins))
            found = render(look).detach()
            self._pending.append((look, found))
            known = torch.cat((known, found.position[found.is_hit(self.hit_share)]))
        self.refresh()

    @torch.no_grad()
    def refresh(self) -> None:
        """Measure what is known by the rays that came since, take them in, and make the grid anew."""
        if not self._pending:
            return
        rays = RayBatch(
            *(torch.cat([getattr(r, name) for r, _ in self._pending]) for name in ("origins", "directions"))
        )
        joined = [
            torch.cat(parts) for parts in zip(*(self._columns(r, h) for r, h in self._pending), strict=True)
        ]
        points, distance, hit, clear = joined
        self._pending.clear()
        if self._known_surface() is not None:
            told = torch.nonzero(hit | clear)[:, 0]
            self._measure(Looks(rays[told], distance[told]))
        stamp = torch.full_like(points[:, :1], float(self.steps))
        self.points.keep(torch.cat((points, stamp), -1)[hit].flip(0))
        self._surface = self._fused()

    def _columns(self, rays: RayBatch, hits: SurfaceHits) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        hit = hits.is_hit(self.hit_share) & (hits.normal.norm(dim=-1) > 0.5)
        distance = torch.where(hit, (hits.position - rays.origins).norm(dim=-1), torch.inf)
        columns = torch.cat((hits.position, hits.normal, hits.color), -1)
        return columns, distance, hit & columns.isfinite().all(-1), hits.opacity < CLEAR

    def _fused(self) -> FusedSurface:
        rows = self.points.kept()
        rows = rows[rows[:, 3:6].square().sum(-1) > 0]
        return fuse(rows[:, :3], rows[:, 3:6], rows[:, 6:9], self.radius, self.resolution)

    def _measure(self, looks: Looks) -> None:
        """Compare fresh rays with the grid, and drop the points that they pass through."""
        found = self._trace(looks.rays)
        hit = looks.distance.isfinite()
        both = hit & found.hit
        error = (found.distance - looks.distance)[both].abs()
        rows = self.points.kept()
        held = rows[:, 3:6].square().sum(-1) > 0
        middle, most = (
            error.quantile(torch.tensor([0.5, 0.95]).to(error)).tolist() if len(error) else (0.0, 0.0)
        )
        self._report = ProxyReport(
            points=int(held.sum()),
            age=(self.steps - rows[held, 9]).mean().item() if held.any() else 0.0,
            agreement=(hit == found.hit).float().mean().item() if len(hit) else 1.0,
            error=middle,
            error_95=most,
            cell=self.cell,
        )
        through = found.hit & (looks.distance > found.distance + APART * self.cell)
        place = looks.rays.origins + found.distance[:, None] * looks.rays.directions
        stale = torch.zeros(self.resolution**3, dtype=torch.bool, device=place.device)
        stale[self._cells(place[through])] = True
        around = (
            nn.functional.max_pool3d(stale.view(1, 1, *[self.resolution] * 3).float(), 3, 1, 1).view(-1) > 0
        )
        rows[around[self._cells(rows[:, :3])], 3:6] = 0.0  # a view of the ring: written in place

    def _cells(self, x: Float[Tensor, "P 3"]) -> Int[Tensor, " P"]:
        i, j, k = ((x + self.radius) / self.cell).round().long().clamp(0, self.resolution - 1).unbind(-1)
        return (k * self.resolution + j) * self.resolution + i

    # ------------------------------------------------------------------------------------------------ tracing

    @torch.no_grad()
    def scene_light(self, x: Float[Tensor, "N 3"], wi: Float[Tensor, "N S 3"]) -> SceneLight:
        """What the scene sends to surface points (`hosts.base.LightsItself`); nothing while nothing was seen.

        Rays start above the grid's own surface, so that its error shadows nothing.
        """
        directions = wi.reshape(-1, 3)
        surface = self._known_surface()
        if surface is None:
            nothing = torch.zeros_like(wi[..., 0])
            return SceneLight(nothing > 0, torch.zeros_like(wi), torch.full_like(nothing, torch.inf))
        normal, height = (
            grid_normal(surface.distance, self.radius, x),
            look_up(surface.distance, self.radius, x),
        )
        lift = (START * self.cell - height).clamp(0, (START + 1) * self.cell)
        start = (x + lift[:, None] * normal)[:, None].expand_as(wi).reshape(-1, 3)
        found = self._trace(RayBatch(start, directions))
        rows = torch.nonzero(found.hit)[:, 0]
        place = start[rows] + found.distance[rows, None] * directions[rows]
        radiance = torch.zeros_like(directions)
        radiance[rows] = self._sent(place, -directions[rows])
        origin = x[:, None].expand_as(wi).reshape(-1, 3)[rows]
        distance = torch.full_like(directions[:, 0], torch.inf)
        distance[rows] = (place - origin).norm(dim=-1)
        return SceneLight(found.hit.view(wi.shape[:2]), radiance.view(wi.shape), distance.view(wi.shape[:2]))

    @torch.no_grad()
    def render(self, rays: RayBatch) -> SurfaceHits:
        """What the grid shows along rays; constants, no gradient. Black where they meet nothing."""
        surface = self._known_surface()
        nothing, zero = torch.zeros_like(rays.origins), torch.zeros_like(rays.origins[:, 0])
        if surface is None:
            return SurfaceHits(nothing, rays.origins, nothing, zero, zero)
        found = self._trace(rays)
        rows = torch.nonzero(found.hit)[:, 0]
        place = rays.origins[rows] + found.distance[rows, None] * rays.directions[rows]
        normal = grid_normal(surface.distance, self.radius, place)
        share = found.hit.to(zero.dtype)
        return SurfaceHits(
            color=nothing.index_put((rows,), self._sent(place, -rays.directions[rows])),
            position=rays.origins.index_put((rows,), place),
            normal=nothing.index_put((rows,), normal),
            opacity=share,
            concentration=share,
        )

    def report(self) -> ProxyReport | None:
        """How good the proxy is; none before the second refresh."""
        return self._report

    def _sent(self, place: Float[Tensor, "P 3"], wo: Float[Tensor, "P 3"]) -> Float[Tensor, "P 3"]:
        if self._radiance is not None and len(place):
            return self._radiance(place, wo)
        return mean_at(self._surface, self.radius, place)

    def _known_surface(self) -> FusedSurface | None:
        if self._surface is None and self.points.filled:  # of a checkpoint
            self._surface = self._fused()
        return self._surface

    def _trace(self, rays: RayBatch) -> GridHits:
        """Where rays, which may start outside the cube, meet the grid's surface."""
        grid = self._known_surface().distance
        enter, passes = self._entry(rays)
        start = rays.origins + enter[:, None] * rays.directions
        found = trace_grid(grid, self.radius, start, rays.directions)
        hit = found.hit & passes
        # The tracing ends before the surface; the last bit is a step of Newton's method.
        rows = torch.nonzero(hit)[:, 0]
        directions = rays.directions[rows]
        place = start[rows] + found.distance[rows, None] * directions
        cosine = -(grid_normal(grid, self.radius, place) * directions).sum(-1)
        rest = (look_up(grid, self.radius, place) / cosine.clamp_min(GRAZING)).clamp(-self.cell, self.cell)
        return GridHits((enter + found.distance).index_add(0, rows, rest), hit)

    def _entry(self, rays: RayBatch) -> tuple[Float[Tensor, " P"], Bool[Tensor, " P"]]:
        """The distance at which rays enter the cube, 0 from within, and which ones do."""
        direction = torch.where(rays.directions.abs() < 1e-9, 1e-9, rays.directions)
        ends = torch.stack(
            ((-self.radius - rays.origins) / direction, (self.radius - rays.origins) / direction)
        )
        near, far = ends.amin(0).amax(-1).clamp_min(0.0), ends.amax(0).amin(-1)
        return torch.where(near > 0, near + 1e-4 * self.radius, near), far > near

    # -------------------------------------------------------------------------------------------- checkpoints

    def get_extra_state(self) -> dict[str, Any]:
        """Steps that were observed, and the rays that came since the last refresh."""
        pending = [{**_tensors(rays), **_tensors(hits)} for rays, hits in self._pending]
        return {"steps": self.steps, "pending": pending}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """The inverse of `get_extra_state`; the grid is made of the points again when it is asked."""
        self.steps, self._surface, self._report = state["steps"], None, None
        self._pending = [
            (_made(RayBatch, tensors), _made(SurfaceHits, tensors)) for tensors in state["pending"]
        ]


Part = TypeVar("Part", RayBatch, SurfaceHits)


def _tensors(part: RayBatch | SurfaceHits) -> dict[str, Tensor]:
    return {f.name: getattr(part, f.name) for f in fields(part)}


def _made(kind: type[Part], tensors: Mapping[str, Tensor]) -> Part:
    return kind(**{f.name: tensors[f.name] for f in fields(kind)})
