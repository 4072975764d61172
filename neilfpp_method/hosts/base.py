"""What the method asks of geometry and radiance, so that it can sit on any NeRF-like system.

A host renders rays. All else is an optional capability, found by `isinstance` on one of the small protocols
below: a host that lacks one loses what the protocol says, nothing more.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import Parameter

from neilfpp_method.data.views import Camera
from neilfpp_method.schedule import StageTable
from neilfpp_method.structures import LossTerms, PixelBatch, RayBatch, SceneLight, SurfaceHits

__all__ = [
    "HasParameterGroups",
    "HasSdf",
    "HasStages",
    "HasSurfaceWidth",
    "Host",
    "ImageHost",
    "KnowsMisses",
    "KnowsRadiance",
    "LightsItself",
    "ReadsOutputs",
    "Regularised",
    "RegularisedHits",
    "SmoothsNormals",
]


@runtime_checkable
class Host(Protocol):
    """Geometry and radiance of a scene. One that cannot answer rays that leave a surface says so by the
    attribute `answers_secondary_rays = False`; `render` is then asked with camera rays alone.
    """

    def render(self, rays: RayBatch) -> SurfaceHits:
        """Colour, hit position and normal of each ray, differentiable in the host's parameters."""
        ...


@runtime_checkable
class ImageHost(Protocol):
    """Geometry and radiance that come as whole images: splats and other rasterisers. It answers no secondary
    rays; what a surface sends to another is asked of a proxy (`hosts.proxy`), and the hits of a training step
    are handed to `losses`.
    """

    def render_image(self, camera: Camera) -> SurfaceHits:
        """What the camera sees, scene frame, a row per pixel; `hosts.image.image_hits` makes it."""
        ...


@dataclass(frozen=True)
class RegularisedHits:
    """Rendered rays with the host's own losses at the places that rendering visited."""

    hits: SurfaceHits
    terms: LossTerms


@runtime_checkable
class Regularised(Protocol):
    """A host with losses of its own. Without: L_vol alone moves the geometry."""

    def render_regularised(self, batch: PixelBatch, names: Collection[str]) -> RegularisedHits:
        """As `render`, and the named losses that the host has; losses not named are not computed."""
        ...


@runtime_checkable
class LightsItself(Protocol):
    """A host that traces many rays cheaply. Without: hard inter-reflection renders every ray, slowly."""

    def scene_light(self, x: Float[Tensor, "N 3"], wi: Float[Tensor, "N S 3"]) -> SceneLight:
        """What arrives at surface points x from the scene's own surfaces along wi; no gradient."""
        ...


@runtime_checkable
class KnowsMisses(Protocol):
    """A host that knows cheaply which rays meet nothing. Without: every ray for L_ref is rendered."""

    def may_meet(self, rays: RayBatch) -> Bool[Tensor, " N"]:
        """Which of the rays, which leave a surface, may meet one: the others are not worth rendering."""
        ...


@runtime_checkable
class KnowsRadiance(Protocol):
    """A host that knows what a point of its surface sends, without a ray. Without: the proxy of a host that
    traces no rays brings the mean of what the training rays saw there.
    """

    def radiance(self, x: Float[Tensor, "N 3"], wo: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
        """Linear radiance that leaves surface points x towards wo."""
        ...


@runtime_checkable
class ReadsOutputs(Protocol):
    """A host whose renderer returns its own dictionary. Without: the names of `hosts.answers` apply."""

    def read_outputs(self, rays: RayBatch, outputs: Mapping[str, Tensor]) -> SurfaceHits:
        """The hits of the rays, from what the host's renderer returned for them."""
        ...


@runtime_checkable
class HasSurfaceWidth(Protocol):
    """A host whose surface is a soft layer. Without: rays for L_ref start at a fixed distance from it."""

    def surface_width(self) -> Float[Tensor, ""]:
        """Scale of the layer, scene units (VolSDF's β)."""
        ...


@runtime_checkable
class SmoothsNormals(Protocol):
    """A host with wavy normals that knows better ones. Without: surfaces are shaded with hit normals."""

    def smooth_normals(
        self, position: Float[Tensor, "N 3"], normal: Float[Tensor, "N 3"]
    ) -> Float[Tensor, "N 3"]:
        """Unit normals at hits for shading; constants, no gradient."""
        ...


@runtime_checkable
class HasParameterGroups(Protocol):
    """A host whose parameters are ours to optimise. Without: its own trainer moves it, or nothing does."""

    def parameter_groups(self) -> Mapping[str, list[Parameter]]:
        """Parameters by field: geometry, beta, radiance, background."""
        ...


@runtime_checkable
class HasSdf(Protocol):
    """A host whose surface is the zero set of a distance field. Without: there is no mesh to export."""

    def sdf(self, x: Float[Tensor, "P 3"]) -> Float[Tensor, " P"]:
        """Signed distance at points of the scene frame, negative inside."""
        ...


@runtime_checkable
class HasStages(Protocol):
    """A host that does not train as a distance field does. Without: the stages of the paper."""

    stages: StageTable
