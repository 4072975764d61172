"""The reference host: a signed distance field rendered as a volume (VolSDF, Yariv et al. 2021; METHOD §3)."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from neilfpp_method import losses
from neilfpp_method.fields.sdf import SdfField, SdfSample
from neilfpp_method.hosts.base import RegularizedHits
from neilfpp_method.hosts.camera_places import check_cameras
from neilfpp_method.hosts.patches import PatchViews, patch_loss
from neilfpp_method.hosts.radiance import background_field, radiance_field
from neilfpp_method.hosts.regularizer_points import SURFACE_WIDTH, regularizer_inputs
from neilfpp_method.hosts.smooth_normals import smooth_normals
from neilfpp_method.settings.facts import SceneFacts
from neilfpp_method.settings.types import NeilfConfig
from neilfpp_method.shading.frame import safe_normalize
from neilfpp_method.structures import LossTerm, OrientedPoints, PixelBatch, RayBatch, SceneLight, SurfaceHits
from neilfpp_method.timing.ledger import timed
from neilfpp_method.volume.compositing import Weights, composite, depth_weights, sample_weights
from neilfpp_method.volume.density import DensityKind, LaplaceDensity, optical_depth
from neilfpp_method.volume.distance_grid import GRID_RESOLUTION, sample_grid, trace_grid
from neilfpp_method.volume.empty_space import EmptySpace, EvaluationSpace, evaluation_space
from neilfpp_method.volume.entering_samples import entering_samples
from neilfpp_method.volume.free_space import FreeSpace, free_balls
from neilfpp_method.volume.hits import blend_hits
from neilfpp_method.volume.intersect import Interval, sphere_interval
from neilfpp_method.volume.partition import SampleCounts, sample_counts
from neilfpp_method.volume.samplers import error_bounded_samples

__all__ = ["VolSdfHost"]

NORMAL_RADIUS = 0.08
"""Radius within which normals are smoothed for shading, scene units."""
OWN_LOSSES = frozenset({"eikonal", "hessian", "surface", "point_cloud", "mask", "patches"})
"""Losses that `VolSdfHost.render_regularized` computes."""
GRID_LIFE = 100
"""Training steps of the geometry after which the distance grid is sampled again."""


@dataclass(frozen=True)
class March:
    """Samples along rays from near to far, the values of G there, and the blended hits."""

    distances: Float[Tensor, "N M"]
    surface: SdfSample
    hits: SurfaceHits


class VolSdfHost(nn.Module):
    """G and R, rendered as a volume with the Laplace density of G.

    Args:
        config: the settings.
        facts: the range and the initial value of R, and the background, which is not "auto" any more.
        points: oriented points on the surface, scene frame, for L_pcd.
        cameras: camera positions, scene frame; the space around them is empty (`volume.free_space`).
            Checkpoints contain them, because fields have no meaning in another scene frame.

    Attributes:
        starts_from_shape: whether G has been fitted to a known shape (`train.start`); in checkpoints.
        patch_views: the images whose patches L_patch compares; None without this loss.
    """

    def __init__(
        self,
        config: NeilfConfig,
        facts: SceneFacts,
        points: OrientedPoints | None = None,
        cameras: Float[Tensor, "V 3"] | None = None,
    ) -> None:
        super().__init__()
        self.config = config
        self.starts_from_shape = False
        self.patch_views: PatchViews | None = None
        self.radiance_scale = facts.radiance_scale
        self.background_kind = facts.background
        # Buffers follow the host to its device. They are not in checkpoints, as the capture has them.
        self.register_buffer("point_position", None if points is None else points.position, persistent=False)
        self.register_buffer("point_normal", None if points is None else points.normal, persistent=False)
        self.radius = radius = config.background.radius
        sdf, volume = config.host.sdf, config.host.volume
        self.sdf_field = SdfField(sdf, config.encoding, radius)
        self.radiance_field = radiance_field(config, facts, sdf.feature_width)
        self.density = LaplaceDensity(volume.beta_init)
        self.register_buffer("background_color", torch.tensor(facts.background_color))
        self.background = background_field(config, facts)
        self.cameras = cameras
        balls = None if cameras is None else free_balls(cameras, self.point_position, radius)
        self.free_space = None if balls is None else FreeSpace(balls, radius)
        self.empty_space = EmptySpace(radius) if volume.skip_empty else None
        self.sample_counts = sample_counts(volume)
        resolution = GRID_RESOLUTION if config.light.inter_reflection == "hard" else 0
        # The grid and its age are in checkpoints, so that a resumed run traces the same grid.
        self.register_buffer("distance_grid", torch.zeros(resolution, resolution, resolution))
        self.grid_age: int | None = None
        # Made at first use in evaluation; not in checkpoints.
        self._evaluation_space: EvaluationSpace | None = None

    # -------------------------------------------------------------------------------------- the host contract

    def render(self, rays: RayBatch) -> SurfaceHits:
        """Colour, position and normal of each ray, blended with the rendering weights (METHOD §3).

        With `host.volume.skip_empty`, evaluation without gradients samples only the parts of rays that may
        be visible, according to a grid of the current field.
        """
        if self.training or torch.is_grad_enabled():
            return self._march(rays).hits
        return self._render_fixed(rays, colored=True)

    def render_regularized(self, batch: PixelBatch, names: Collection[str]) -> RegularizedHits:
        """As `render`, with those of `OWN_LOSSES` that are in `names`. Without "volume" among them, colours
        are not evaluated, and are 0.
        """
        colored = "volume" in names
        if not torch.is_grad_enabled() and not OWN_LOSSES & set(names):
            return RegularizedHits(self._render_fixed(batch.rays, colored), {})
        march = self._march(batch.rays, colored=colored)
        if march.surface.distance.requires_grad:
            if self.grid_age is not None:
                self.grid_age += 1
            if self.empty_space is not None:
                self.empty_space.moved()
        return RegularizedHits(march.hits, self._regularizers(march, batch, names))

    def surface_width(self) -> Float[Tensor, ""]:
        """β, the scale of the Laplace density, without gradient."""
        return self.density.beta().detach()

    def limit_surface_width(self, width: float) -> None:
        """Lower β to `width` if it is larger; to half of it if "auto" has chosen the isotropic density, whose
        hits are not moved to the zero set: their distance from it grows with the width.
        """
        is_automatic = self.config.host.volume.density == "auto"
        is_half = is_automatic and self.density_kind == "isotropic"
        self.density.limit_(0.5 * width if is_half else width)

    def parameter_groups(self) -> Mapping[str, list[nn.Parameter]]:
        """The parameters by field."""
        groups = {
            "geometry": list(self.sdf_field.parameters()),
            "beta": list(self.density.parameters()),
            "radiance": list(self.radiance_field.parameters()),
        }
        return (
            groups if self.background is None else groups | {"background": list(self.background.parameters())}
        )

    @torch.no_grad()
    def scene_light(self, x: Float[Tensor, "N 3"], wi: Float[Tensor, "N S 3"]) -> SceneLight:
        """Light from the scene's surfaces at surface points: R where rays through a grid of the SDF hit.

        The grid is sampled at first use, and again after `GRID_LIFE` training steps of the geometry.
        """
        origins = x[:, None].expand_as(wi).reshape(-1, 3)
        directions = wi.reshape(-1, 3)
        traced = trace_grid(self._grid(), self.radius, origins, directions, leaves_surface=True)
        rows = torch.nonzero(traced.hit)[:, 0]
        points = origins[rows] + traced.distance[rows, None] * directions[rows]
        surface = self.sdf_field.with_gradient(points)
        radiance = torch.zeros_like(directions)
        radiance[rows] = self.radiance_field(
            points, -directions[rows], safe_normalize(surface.gradient), surface.feature
        )
        distance = torch.where(traced.hit, traced.distance, torch.inf)
        return SceneLight(traced.hit.view(wi.shape[:2]), radiance.view(wi.shape), distance.view(wi.shape[:2]))

    @torch.no_grad()
    def smooth_normals(
        self, position: Float[Tensor, "N 3"], normal: Float[Tensor, "N 3"]
    ) -> Float[Tensor, "N 3"]:
        """Normals smoothed within `NORMAL_RADIUS` of hits, except across edges."""
        return smooth_normals(lambda x: self._surface(x).gradient, position, normal, NORMAL_RADIUS)

    @torch.no_grad()
    def may_hit(self, rays: RayBatch) -> Bool[Tensor, " N"]:
        """Which rays that start at a surface may hit one, by the grid of empty space; all without a grid."""
        if self.empty_space is None:
            return torch.ones(len(rays), dtype=torch.bool, device=rays.origins.device)
        interval = sphere_interval(rays.origins, rays.directions, self.radius)
        return self.empty_space.may_hit(self.sdf, rays, interval, self.surface_width())

    def get_extra_state(self) -> dict[str, Any]:
        """The age of the distance grid, the kind of start, and the cameras, for checkpoints."""
        own = {"grid_age": self.grid_age, "starts_from_shape": self.starts_from_shape}
        return {**own, "cameras": self.cameras}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Restore what `get_extra_state` returned, except the cameras, which must not have moved.

        Raises:
            UserError: see `check_cameras`.
        """
        # Checkpoints of earlier versions have no cameras.
        check_cameras(state.get("cameras"), self.cameras)
        self.grid_age, self.starts_from_shape = state["grid_age"], state["starts_from_shape"]

    # ----------------------------------------------------------------------------------------------- geometry

    @property
    def density_kind(self) -> DensityKind:
        """The kind of density; "auto" is entering if geometry starts from a known shape."""
        kind = self.config.host.volume.density
        if kind != "auto":
            return kind
        return "entering" if self.starts_from_shape else "isotropic"

    @property
    def points(self) -> OrientedPoints | None:
        """The oriented points on the surface for L_pcd, scene frame; None if there are none."""
        if self.point_position is None:
            return None
        return OrientedPoints(self.point_position, self.point_normal)

    def _grid(self) -> Float[Tensor, "R R R"]:
        if self.grid_age is None or self.grid_age >= GRID_LIFE:
            fresh = sample_grid(self.sdf, self.radius, self.distance_grid.shape[0], self.distance_grid)
            self.distance_grid.copy_(fresh)
            self.grid_age = 0
        return self.distance_grid

    def sdf(self, x: Float[Tensor, "P 3"]) -> Float[Tensor, " P"]:
        """Signed distance of the scene's surface: G, with free space cut out of it."""
        distance = self.sdf_field(x)
        if self.free_space is None:
            return distance
        return torch.maximum(distance, self.free_space(x).depth.to(distance.dtype))

    def _surface(self, x: Float[Tensor, "P 3"]) -> SdfSample:
        """As `sdf`, with its gradient and the feature for R."""
        sample = self.sdf_field.with_gradient(x)
        if self.free_space is None:
            return sample
        free = self.free_space(x)
        within = free.depth > sample.distance
        return SdfSample(
            torch.where(within, free.depth, sample.distance),
            torch.where(within[:, None], free.gradient, sample.gradient),
            sample.feature,
        )

    # ---------------------------------------------------------------------------------------------- rendering

    def _render_fixed(self, rays: RayBatch, colored: bool) -> SurfaceHits:
        """Render a field that is not being trained; rays that miss the scene cost only grid look-ups."""
        # Without a background the scene sphere has the radiance R, so no ray can be skipped.
        if self.empty_space is None or self.background_kind == "none":
            return self._march(rays, colored=colored).hits
        self._evaluation_space = evaluation_space(self._evaluation_space, self.sdf_field, self.radius)
        interval = sphere_interval(rays.origins, rays.directions, self.radius)
        span = self._evaluation_space.space.may_show(self.sdf, rays, interval, self.surface_width())
        zeros = torch.zeros_like(interval.far)
        missed = SurfaceHits(
            color=self._background(rays, torch.ones_like(zeros), at_far=torch.zeros_like(rays.origins)),
            position=rays.origins + interval.far[:, None] * rays.directions,
            normal=torch.zeros_like(rays.origins),
            opacity=zeros,
            concentration=zeros,
        )
        rows = torch.nonzero(span.has_part)[:, 0]
        if not len(rows):
            return missed
        part = Interval(span.interval.near[rows], span.interval.far[rows])
        visible = self._march(rays[rows], part, colored).hits
        return missed.map_named(lambda name, values: values.index_put((rows,), getattr(visible, name)))

    def _march(self, rays: RayBatch, part: Interval | None = None, colored: bool = True) -> March:
        """Sample and blend rays, in `part` of each if it is known; colours are 0 unless `colored`."""
        interval = part or sphere_interval(rays.origins, rays.directions, self.radius)
        narrowed = part is not None
        if self.empty_space is not None and self.training and not narrowed:
            narrow = self.empty_space.narrow(self.sdf, rays, interval, self.surface_width())
            # Without a background the scene sphere has the radiance R: rays are sampled up to it.
            interval = Interval(narrow.near, interval.far) if self.background_kind == "none" else narrow
            narrowed = True
        counts = self.sample_counts.of_narrowed_rays() if narrowed else self.sample_counts
        distances = self._sample(rays, interval, counts)
        points = rays.origins[:, None] + distances[..., None] * rays.directions[:, None]
        surface = self._surface(points.reshape(-1, 3))
        if surface.distance.requires_grad:
            # A step may follow, and the fused optimizers do not count the versions of parameters.
            self._evaluation_space = None
        sdf = surface.distance.reshape(distances.shape)
        weights = depth_weights(optical_depth(self.density_kind, sdf, distances, self.density.beta()))
        normals = safe_normalize(surface.gradient)
        radiance = None
        if colored:
            wo = (-rays.directions)[:, None].expand_as(points).reshape(-1, 3)
            radiance = self.radiance_field(points.reshape(-1, 3), wo, normals, surface.feature)
            radiance = radiance.view_as(points)
        hits = self._blend(rays, distances, weights, surface, normals.view_as(points), radiance)
        return March(distances, surface, hits)

    def _sample(self, rays: RayBatch, interval: Interval, counts: SampleCounts) -> Float[Tensor, "N M"]:
        beta = self.density.beta().detach()
        if self.density_kind == "entering":
            return entering_samples(self.sdf, rays, interval, beta, counts, self.training)
        return error_bounded_samples(self.sdf, rays, interval, beta, counts, self.training).distances

    def _blend(
        self,
        rays: RayBatch,
        distances: Float[Tensor, "N M"],
        intervals: Weights,
        surface: SdfSample,
        normals: Float[Tensor, "N M 3"],
        radiance: Float[Tensor, "N M 3"] | None,
    ) -> SurfaceHits:
        sdf, gradient = surface.distance.view_as(distances), surface.gradient.view_as(normals)
        hit = blend_hits(self.density_kind, rays.directions, distances, intervals, sdf, gradient)
        color = torch.zeros_like(rays.origins)
        if radiance is not None:
            behind = self._background(rays, intervals.transmittance, radiance[:, -1])
            color = composite(sample_weights(intervals.weights), radiance) + behind
        return SurfaceHits(
            color=color,
            position=rays.origins + hit.depth[:, None] * rays.directions,
            normal=safe_normalize(composite(hit.weights, normals)),
            opacity=intervals.opacity,
            concentration=hit.concentration,
        )

    def _background(
        self, rays: RayBatch, transmittance: Float[Tensor, " N"], at_far: Float[Tensor, "N 3"]
    ) -> Float[Tensor, "N 3"]:
        """Radiance from beyond the samples: that of the background, or without one R on the scene sphere.

        In the published code the sphere is an opaque surface of the distance field, so a ray that reaches it
        has the radiance R there (`at_far`). It is not a surface of the object: opacity and hits exclude it.
        """
        if self.background_kind == "none":
            return transmittance[:, None] * at_far
        if self.background is not None:
            return transmittance[:, None] * self.background(rays.origins, rays.directions)
        return transmittance[:, None] * self.background_color

    # ------------------------------------------------------------------------------------------- regularisers

    @timed("regularizers")
    def _regularizers(self, march: March, batch: PixelBatch, names: Collection[str]) -> dict[str, LossTerm]:
        terms = {}
        if {"eikonal", "surface", "hessian"} & set(names):
            where, field = self.config.host.loss.points, self.sdf_field.with_gradient
            inputs = regularizer_inputs(where, march.surface, march.hits.position, field, self.radius)
        if "eikonal" in names:
            terms["eikonal"] = losses.eikonal(inputs.gradient)
        if "surface" in names:
            terms["surface"] = losses.surface(inputs.distance, SURFACE_WIDTH[self.config.host.loss.points])
        if "hessian" in names:
            terms["hessian"] = losses.hessian(self.sdf_field.hessian(inputs.hessian_points))
        if "point_cloud" in names and (points := self.points) is not None:
            count = len(points.position)
            drawn = points[torch.randint(count, (len(batch),), device=points.position.device)]
            sample = self.sdf_field.with_gradient(drawn.position)
            terms["point_cloud"] = losses.point_cloud(sample.distance, sample.gradient, drawn.normal)
        if "mask" in names:
            terms["mask"] = self._mask_loss(march, batch)
        if "patches" in names and self.patch_views is not None:
            share = self.config.shading.hit_share
            terms["patches"] = patch_loss(self.patch_views, self._surface, march.hits, batch, share)
        return terms

    def _mask_loss(self, march: March, batch: PixelBatch) -> LossTerm:
        """The mask loss, with β detached: it must move surfaces, not widen them."""
        beta, distance = self.density.beta().detach(), march.surface.distance.view_as(march.distances)
        depth = optical_depth(self.density_kind, distance, march.distances, beta).sum(-1)
        return losses.mask(depth, batch.mask, batch.mask_known, beta)
