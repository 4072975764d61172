"""A traceable proxy for the surface of a host without cheap tracing, built from training rays.

Hits of camera rays are oriented points. The newest of them are fused into a grid of distances
(`volume.fusion`) with the mean observed radiance. Rays between surfaces are sphere-traced in the grid, so
visibility, hard inter-reflection, an environment map and lamps work on any host.

Before new rays are added, they are traced through the current grid. This measures its error, and removes
points that the new rays pass through. The proxy therefore follows a surface that changes, with a delay of a
few dozen steps.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from neilfpp_method.hosts.conversion import no_hits
from neilfpp_method.lighting.ring import Ring
from neilfpp_method.shading.frame import safe_normalize
from neilfpp_method.structures import Indexable, RayBatch, SceneLight, SurfaceHits
from neilfpp_method.volume.distance_grid import GridHits, look_up, trace_grid
from neilfpp_method.volume.fusion import FusedSurface, fuse_surface, grid_normal, mean_at

__all__ = ["ProxyReport", "SurfaceProxy"]

POINTS = 65_536
"""Number of points kept: about five per cell on a surface of ten square units in a grid of 128³."""
REFRESH_INTERVAL = 64
"""Steps between two refreshes. The first refreshes are at steps 1, 2, 4, 8, …"""
EXPLORING_BATCHES, EXPLORING_RAYS = 16, 512
"""Number of batches, and rays per batch, with which `explore` explores the surface."""
EXPLORING_RADIUS = 0.2
"""Largest offset of the targets of `explore` from known hits, per axis, scene units."""
MAX_OVERSHOOT = 2.0
"""A ray that goes this much further than the grid's surface, in cells, shows that points are outdated."""
MAX_MISS_OPACITY = 0.01
"""Largest opacity of a ray that counts as a miss."""
MIN_COSINE = 0.2
"""Lower bound on the cosine between ray and normal in the final Newton step onto the surface."""

log = logging.getLogger(__name__)

Radiance = Callable[[Float[Tensor, "N 3"], Float[Tensor, "N 3"]], Float[Tensor, "N 3"]]


@dataclass(frozen=True)
class ProxyReport:
    """Error of the proxy, measured on the rays since the last refresh, before they were added.

    Attributes:
        points: number of points that it consists of.
        age: mean number of steps since the points were observed.
        agreement: share of rays that hit in both host and proxy, or miss in both.
        error: median difference of the distances along rays that hit in both, scene units.
        error_95: 95th percentile of that difference.
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
class StoredPoints(Indexable):
    """Surface points in the memory of the proxy; its tensors are views of that memory.

    Attributes:
        position: the points, scene frame.
        normal: their outward unit normals; zero for a point that has been removed.
        radiance: linear radiance that was observed there.
        step: number of steps observed when the point was added.
    """

    position: Float[Tensor, "P 3"]
    normal: Float[Tensor, "P 3"]
    radiance: Float[Tensor, "P 3"]
    step: Float[Tensor, "P 1"]

    @property
    def is_valid(self) -> Bool[Tensor, " P"]:
        """Which points have not been removed."""
        return self.normal.square().sum(-1) > 0


@dataclass(frozen=True)
class ObservedRays:
    """Camera rays with the distances of the host's hits, infinite for a miss."""

    rays: RayBatch
    distance: Float[Tensor, " N"]


@dataclass(frozen=True)
class RenderedRays:
    """Rays, and what the host rendered for them."""

    rays: RayBatch
    hits: SurfaceHits

    def map(self, function: Callable[[Tensor], Tensor]) -> RenderedRays:
        """Replace every tensor by `function(tensor)`."""
        return RenderedRays(self.rays.map(function), self.hits.map(function))


@dataclass(frozen=True)
class CubeEntry:
    """The distances at which rays enter the cube of the grid, 0 from inside, and whether they do."""

    distance: Float[Tensor, " P"]
    passes: Bool[Tensor, " P"]


class SurfaceProxy(nn.Module):
    """The newest points of a surface, and a grid made from them. A checkpoint holds only the points.

    Args:
        radius: half the edge of the cube that contains the scene, scene units.
        resolution: vertices of the grid along an edge.
        hit_share: smallest concentration of a hit.
        radiance: radiance of the host at surface points x towards wo; if None, the mean observed radiance.
    """

    def __init__(
        self, radius: float, resolution: int, hit_share: float, radiance: Radiance | None = None
    ) -> None:
        super().__init__()
        self.radius = radius
        self.resolution = resolution
        self.hit_share = hit_share
        # Rows as in `StoredPoints`.
        self.points = Ring(POINTS, 10)
        self.steps = 0
        self._radiance = radiance
        self._pending: list[RenderedRays] = []
        self._surface: FusedSurface | None = None
        self._report: ProxyReport | None = None

    @property
    def cell(self) -> float:
        """Edge of a cell of the grid, scene units."""
        return 2 * self.radius / (self.resolution - 1)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> SurfaceProxy:
        """Convert the module: `nn.Module` calls this for `to`, `double` and `cuda`, on any parent as well."""
        super()._apply(fn, recurse)
        self._pending = [rendered.map(fn) for rendered in self._pending]
        # The grid is rebuilt from the converted points at its next use.
        self._surface = None
        return self

    # ---------------------------------------------------------------------------------------------- gathering

    @torch.no_grad()
    def observe(self, rays: RayBatch, hits: SurfaceHits) -> None:
        """Add the camera rays and hits of a training step, and refresh the grid when it is due."""
        self.steps += 1
        self._pending.append(RenderedRays(rays, hits.detach()))
        if self.steps % REFRESH_INTERVAL == 0 or (
            self.steps < REFRESH_INTERVAL and self.steps & (self.steps - 1) == 0
        ):
            self.refresh()

    @torch.no_grad()
    def explore(self, render: Callable[[RayBatch], SurfaceHits], rays: RayBatch, hits: SurfaceHits) -> None:
        """Explore the surface before the first step, so that there is enough of it to trace.

        Rays go from the origins of the first batch to points near its hits.

        Args:
            render: renders rays with the host.
            rays, hits: the first batch and its hits.
        """
        hit_points = hits.position[hits.is_hit(self.hit_share)].detach()
        for _ in range(EXPLORING_BATCHES if len(hit_points) else 0):
            origins = rays.origins[torch.randint(len(rays), (EXPLORING_RAYS,), device=hit_points.device)]
            targets = hit_points[torch.randint(len(hit_points), (EXPLORING_RAYS,), device=hit_points.device)]
            targets = targets + EXPLORING_RADIUS * (2 * torch.rand_like(targets) - 1)
            new_rays = RayBatch(origins, safe_normalize(targets - origins))
            new_hits = render(new_rays).detach()
            self._pending.append(RenderedRays(new_rays, new_hits))
            hit_points = torch.cat((hit_points, new_hits.position[new_hits.is_hit(self.hit_share)]))
        self.refresh()

    @torch.no_grad()
    def refresh(self) -> None:
        """Measure the error on the rays since the last refresh, add them, and rebuild the grid."""
        if not self._pending:
            return
        rays = RayBatch.joined([rendered.rays for rendered in self._pending])
        hits = SurfaceHits.joined([rendered.hits for rendered in self._pending])
        self._pending.clear()
        hit = hits.is_hit(self.hit_share) & (hits.normal.norm(dim=-1) > 0.5)
        distance = torch.where(hit, (hits.position - rays.origins).norm(dim=-1), torch.inf)
        points = torch.cat((hits.position, hits.normal, hits.color), -1)
        hit &= points.isfinite().all(-1)
        if self._known_surface() is not None:
            rows = torch.nonzero(hit | (hits.opacity < MAX_MISS_OPACITY))[:, 0]
            observed = ObservedRays(rays[rows], distance[rows])
            traced = self._trace(observed.rays)
            self._report = self._compare(observed, traced)
            self._remove_crossed_points(observed, traced)
        stamp = torch.full_like(points[:, :1], float(self.steps))
        self.points.keep(torch.cat((points, stamp), -1)[hit].flip(0))
        self._surface = self._fused()

    def _stored(self) -> StoredPoints:
        return StoredPoints(*self.points.kept().split((3, 3, 3, 1), -1))

    def _fused(self) -> FusedSurface:
        """The surface of the stored points."""
        stored = self._stored()
        valid = stored[stored.is_valid]
        return fuse_surface(valid.position, valid.normal, valid.radiance, self.radius, self.resolution)

    def _compare(self, observed: ObservedRays, traced: GridHits) -> ProxyReport:
        """Compare new rays of the host with those through the grid."""
        hit = observed.distance.isfinite()
        error = (traced.distance - observed.distance)[hit & traced.hit].abs()
        stored = self._stored()
        valid = stored.is_valid
        median, error_95 = (
            error.quantile(torch.tensor([0.5, 0.95]).to(error)).tolist() if len(error) else (0.0, 0.0)
        )
        return ProxyReport(
            points=int(valid.sum()),
            age=(self.steps - stored.step[valid, 0]).mean().item() if valid.any() else 0.0,
            agreement=(hit == traced.hit).float().mean().item() if len(hit) else 1.0,
            error=median,
            error_95=error_95,
            cell=self.cell,
        )

    def _remove_crossed_points(self, observed: ObservedRays, traced: GridHits) -> None:
        """Remove the points that rays of the host pass through."""
        through = traced.hit & (observed.distance > traced.distance + MAX_OVERSHOOT * self.cell)
        crossed = observed.rays.origins + traced.distance[:, None] * observed.rays.directions
        stale = torch.zeros(self.resolution**3, dtype=torch.bool, device=crossed.device)
        stale[self._cells(crossed[through])] = True
        # Points in neighbouring cells are removed as well.
        volume = stale.view(1, 1, *[self.resolution] * 3).float()
        stale = nn.functional.max_pool3d(volume, 3, 1, 1).view(-1) > 0
        stored = self._stored()
        # This writes to the memory, of which `normal` is a view.
        stored.normal[stale[self._cells(stored.position)]] = 0.0

    def _cells(self, x: Float[Tensor, "P 3"]) -> Int[Tensor, " P"]:
        """Index of the vertex closest to each point."""
        i, j, k = ((x + self.radius) / self.cell).round().long().clamp(0, self.resolution - 1).unbind(-1)
        return (k * self.resolution + j) * self.resolution + i

    # ------------------------------------------------------------------------------------------------ tracing

    @torch.no_grad()
    def scene_light(self, x: Float[Tensor, "N 3"], wi: Float[Tensor, "N S 3"]) -> SceneLight:
        """Light from the scene's surfaces (`hosts.base.TracesLight`); none before the first refresh."""
        directions = wi.reshape(-1, 3)
        surface = self._known_surface()
        if surface is None:
            zeros = torch.zeros_like(wi[..., 0])
            return SceneLight(zeros > 0, torch.zeros_like(wi), torch.full_like(zeros, torch.inf))
        start = x[:, None].expand_as(wi).reshape(-1, 3)
        traced = self._trace(RayBatch(start, directions), leaves_surface=True)
        rows = torch.nonzero(traced.hit)[:, 0]
        position = start[rows] + traced.distance[rows, None] * directions[rows]
        radiance = torch.zeros_like(directions)
        radiance[rows] = self._outgoing(position, -directions[rows])
        distance = torch.where(traced.hit, traced.distance, torch.inf)
        return SceneLight(traced.hit.view(wi.shape[:2]), radiance.view(wi.shape), distance.view(wi.shape[:2]))

    @torch.no_grad()
    def render(self, rays: RayBatch) -> SurfaceHits:
        """Hits of rays with the grid's surface, without gradient; the colour of a miss is black."""
        surface = self._known_surface()
        missed = no_hits(rays)
        if surface is None:
            return missed
        traced = self._trace(rays)
        rows = torch.nonzero(traced.hit)[:, 0]
        position = rays.origins[rows] + traced.distance[rows, None] * rays.directions[rows]
        normal = grid_normal(surface.distance, self.radius, position)
        share = traced.hit.to(missed.opacity.dtype)
        return SurfaceHits(
            color=missed.color.index_put((rows,), self._outgoing(position, -rays.directions[rows])),
            position=missed.position.index_put((rows,), position),
            normal=missed.normal.index_put((rows,), normal),
            opacity=share,
            concentration=share,
        )

    def report(self) -> ProxyReport | None:
        """Error of the proxy; None before the second refresh."""
        return self._report

    def _outgoing(self, x: Float[Tensor, "P 3"], wo: Float[Tensor, "P 3"]) -> Float[Tensor, "P 3"]:
        """Radiance of surface points x towards wo: that of the host, or the mean observed radiance."""
        if self._radiance is not None and len(x):
            return self._radiance(x, wo)
        return mean_at(self._surface, self.radius, x)

    def _known_surface(self) -> FusedSurface | None:
        """The surface of the last refresh, made again after a checkpoint; None before the first refresh."""
        if self._surface is None and self.points.filled:
            self._surface = self._fused()
        return self._surface

    def _trace(self, rays: RayBatch, *, leaves_surface: bool = False) -> GridHits:
        """Trace rays, which may start outside of the cube, to the surface of the grid."""
        grid = self._known_surface().distance
        entry = self._entry(rays)
        start = rays.origins + entry.distance[:, None] * rays.directions
        traced = trace_grid(grid, self.radius, start, rays.directions, leaves_surface=leaves_surface)
        hit = traced.hit & entry.passes
        # Tracing ends a quarter cell above the surface; a Newton step covers the rest.
        rows = torch.nonzero(hit)[:, 0]
        directions = rays.directions[rows]
        end = start[rows] + traced.distance[rows, None] * directions
        cosine = -(grid_normal(grid, self.radius, end) * directions).sum(-1)
        rest = (look_up(grid, self.radius, end) / cosine.clamp_min(MIN_COSINE)).clamp(-self.cell, self.cell)
        # A ray that starts inside a wall, by the error of the grid, would have to go back to its surface.
        return GridHits((entry.distance + traced.distance).index_add(0, rows, rest).clamp_min(0.0), hit)

    def _entry(self, rays: RayBatch) -> CubeEntry:
        direction = torch.where(rays.directions.abs() < 1e-9, 1e-9, rays.directions)
        ends = torch.stack(
            ((-self.radius - rays.origins) / direction, (self.radius - rays.origins) / direction)
        )
        near, far = ends.amin(0).amax(-1).clamp_min(0.0), ends.amax(0).amin(-1)
        return CubeEntry(torch.where(near > 0, near + 1e-4 * self.radius, near), far > near)

    # -------------------------------------------------------------------------------------------- checkpoints

    def get_extra_state(self) -> dict[str, Any]:
        """Number of observed steps, and the rays since the last refresh, for checkpoints."""
        pending = [{**vars(rendered.rays), **vars(rendered.hits)} for rendered in self._pending]
        return {"steps": self.steps, "pending": pending}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Restore what `get_extra_state` returned; the grid is rebuilt from the points at its next use."""
        self.steps, self._surface, self._report = state["steps"], None, None
        like = self.points.rows
        self._pending = [
            RenderedRays(_from_named(RayBatch, tensors), _from_named(SurfaceHits, tensors)).map(
                lambda t: t.to(like)
            )
            for tensors in state["pending"]
        ]


def _from_named(kind: type[RayBatch | SurfaceHits], tensors: Mapping[str, Tensor]) -> RayBatch | SurfaceHits:
    """Build rays or hits from tensors by name; other tensors are ignored."""
    return kind(**{f.name: tensors[f.name] for f in fields(kind)})
