"""The host contract: what the method needs from a system that provides geometry and radiance.

A host renders rays. Everything else is an optional capability with a small protocol below, detected by
`isinstance`. The docstring of each protocol says what happens without it.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import Parameter

from neilfpp_method.data.cameras.camera import Camera
from neilfpp_method.schedule import StageTable
from neilfpp_method.structures import LossTerms, OrientedPoints, PixelBatch, RayBatch, SceneLight, SurfaceHits

__all__ = [
    "HasParameterGroups",
    "HasPointCloud",
    "HasRadiance",
    "HasSdf",
    "HasStages",
    "HasSurfaceWidth",
    "Host",
    "ImageHost",
    "LimitsSurfaceWidth",
    "PredictsMisses",
    "ReadsOutputs",
    "Regularized",
    "RegularizedHits",
    "SmoothsNormals",
    "StartsFromShape",
    "TracesLight",
]


@runtime_checkable
class Host(Protocol):
    """Geometry and radiance of a scene.

    A host that cannot render rays that start at a surface sets the attribute `answers_secondary_rays =
    False`; `render` then only gets camera rays.
    """

    def render(self, rays: RayBatch) -> SurfaceHits:
        """Colour, hit position and normal of each ray, differentiable in the host's parameters."""
        ...


@runtime_checkable
class ImageHost(Protocol):
    """Geometry and radiance that are rendered as whole images: splats and other rasterisers.

    Light between surfaces is traced by a proxy (`hosts.proxy`). The training loop passes the hits of each
    step to `AttachedNeilf.losses`.
    """

    def render_image(self, camera: Camera) -> SurfaceHits:
        """Hits of all pixels of a camera, one row per pixel, scene frame; see `hosts.image.image_hits`."""
        ...


@dataclass(frozen=True)
class RegularizedHits:
    """Hits of rendered rays, and the host's own losses at the points that rendering evaluated."""

    hits: SurfaceHits
    terms: LossTerms


@runtime_checkable
class Regularized(Protocol):
    """A host with losses of its own. Without it only the losses of the method train the geometry."""

    def render_regularized(self, batch: PixelBatch, names: Collection[str]) -> RegularizedHits:
        """As `render`, with those of the named losses that the host has; others are not computed.

        Without "volume" among the names no step reads the colours, and they may be 0.
        """
        ...


@runtime_checkable
class TracesLight(Protocol):
    """A host that traces many rays cheaply. Without it hard inter-reflection renders every ray."""

    def scene_light(self, x: Float[Tensor, "N 3"], wi: Float[Tensor, "N S 3"]) -> SceneLight:
        """Light that arrives at surface points x from the scene's own surfaces along wi; no gradient."""
        ...


@runtime_checkable
class PredictsMisses(Protocol):
    """A host that can tell cheaply that rays miss the scene. Without it every ray of L_ref is rendered."""

    def may_hit(self, rays: RayBatch) -> Bool[Tensor, " N"]:
        """Which rays, all of which start at a surface, may hit a surface; the others are not rendered."""
        ...


@runtime_checkable
class HasRadiance(Protocol):
    """A host that can evaluate its radiance at surface points. Without it the proxy of a host that traces no
    rays returns the mean radiance of the training rays that hit there.
    """

    def radiance(self, x: Float[Tensor, "N 3"], wo: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
        """Linear radiance that leaves surface points x towards wo."""
        ...


@runtime_checkable
class ReadsOutputs(Protocol):
    """A host whose renderer returns its own dictionary. Without it the names of `hosts.conversion` apply."""

    def read_outputs(self, rays: RayBatch, outputs: Mapping[str, Tensor]) -> SurfaceHits:
        """Convert the dictionary that the host's renderer returned for these rays to hits."""
        ...


@runtime_checkable
class HasSurfaceWidth(Protocol):
    """A host whose surface is a soft layer. Without it rays of L_ref start at a fixed distance from it."""

    def surface_width(self) -> Float[Tensor, ""]:
        """Width of the layer, scene units (VolSDF's β)."""
        ...


@runtime_checkable
class LimitsSurfaceWidth(Protocol):
    """A host whose soft layer can be kept thin. Without it a surface may remain fog."""

    def limit_surface_width(self, width: float) -> None:
        """Lower the width of the layer to `width` (scene units) if it is larger."""
        ...


@runtime_checkable
class StartsFromShape(Protocol):
    """A host whose surface may have the outline of the object before training. R can then learn first.

    Attributes:
        starts_from_shape: whether the initial surface has been fitted to the object.
    """

    starts_from_shape: bool


@runtime_checkable
class SmoothsNormals(Protocol):
    """A host whose normals have errors that shading should correct: it smooths them, and the model tilts
    them. Without it surfaces are shaded with the hit normals.
    """

    def smooth_normals(
        self, position: Float[Tensor, "N 3"], normal: Float[Tensor, "N 3"]
    ) -> Float[Tensor, "N 3"]:
        """Smoothed unit normals at hits, without gradient."""
        ...


@runtime_checkable
class HasParameterGroups(Protocol):
    """A host that is trained together with material and light. Without it the host is borrowed: its own
    trainer, if any, trains it.
    """

    def parameter_groups(self) -> Mapping[str, list[Parameter]]:
        """Parameters by field; the keys are among geometry, beta, radiance and background."""
        ...


@runtime_checkable
class HasSdf(Protocol):
    """A host whose surface is the zero set of a distance field. Without it no mesh can be exported."""

    def sdf(self, x: Float[Tensor, "P 3"]) -> Float[Tensor, " P"]:
        """Signed distance at points of the scene frame, negative inside."""
        ...


@runtime_checkable
class HasPointCloud(Protocol):
    """A host whose surface a point cloud supervises. Without it health checks do not compare the two.

    Attributes:
        points: oriented points on the surface, scene frame; None without a cloud.
    """

    points: OrientedPoints | None


@runtime_checkable
class HasStages(Protocol):
    """A host with a stage table of its own (`schedule`). Without it the stages of the paper apply."""

    stages: StageTable
