"""What travels between the rooms of the package.

N rays or surface points, S incident directions per point. Positions are in the scene frame (the object lies
in the unit sphere, see docs/conventions.md); directions are unit vectors in that frame; radiance is linear
RGB.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from enum import IntEnum
from typing import NamedTuple, TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

__all__ = [
    "PDF_FLOOR",
    "Incident",
    "IncidentSamples",
    "Indexable",
    "LossTerm",
    "LossTerms",
    "Maps",
    "Material",
    "Observed",
    "OrientedPoints",
    "PixelBatch",
    "RayBatch",
    "SceneLight",
    "SceneTracer",
    "Shading",
    "Source",
    "StepResult",
    "SurfaceHits",
    "SurfacePixels",
]

PDF_FLOOR = 1e-6
"""Smallest density divided by, per steradian; it acts on under 2π · 1e-6 of a sampler's directions."""

Structure = TypeVar("Structure", bound="Indexable")


class Indexable:
    """Tensors that share their first axis: row selection and moves between devices in one call."""

    def _map(self: Structure, function) -> Structure:
        tensors = {f.name: getattr(self, f.name) for f in fields(self)}
        return replace(self, **{name: function(t) for name, t in tensors.items() if isinstance(t, Tensor)})

    def __getitem__(self: Structure, rows: Tensor | slice) -> Structure:
        return self._map(lambda t: t[rows])

    def to(self: Structure, device: torch.device | str) -> Structure:
        return self._map(lambda t: t.to(device, non_blocking=True))

    def detach(self: Structure) -> Structure:
        return self._map(Tensor.detach)

    def __len__(self) -> int:
        return getattr(self, fields(self)[0].name).shape[0]


@dataclass(frozen=True)
class RayBatch(Indexable):
    """Rays in the scene frame; `directions` are unit vectors, so a distance along the ray is a length."""

    origins: Float[Tensor, "N 3"]
    directions: Float[Tensor, "N 3"]


@dataclass(frozen=True)
class PixelBatch(Indexable):
    """Rays with what the images say about them.

    `color` is linear radiance for an HDR capture, on the scale that its views share, and display values
    (sRGB) for an LDR one. `mask` is 1 on the object and 0 off it, as far as `mask_known` is 1: everywhere in
    a capture with masks, only where the image shows exactly its background in one without (there the other
    pixels have mask 1). `image_gradient` is the length of the gradient of the image's luminance at the pixel,
    by Scharr's filter: 32 times the change per pixel; 0 where no loss needs it.
    """

    origins: Float[Tensor, "N 3"]
    directions: Float[Tensor, "N 3"]
    color: Float[Tensor, "N 3"]
    mask: Float[Tensor, " N"]
    mask_known: Float[Tensor, " N"]
    image_gradient: Float[Tensor, " N"]
    view: Int[Tensor, " N"]

    @property
    def rays(self) -> RayBatch:
        return RayBatch(self.origins, self.directions)


@dataclass(frozen=True)
class OrientedPoints(Indexable):
    """Points on the surface with their unit normals, away from it, in the scene frame."""

    position: Float[Tensor, "P 3"]
    normal: Float[Tensor, "P 3"]


@dataclass(frozen=True)
class SurfaceHits(Indexable):
    """Where rays meet the surface, and what they see there.

    `color` is the linear radiance that the host renders for the whole ray, background included; `position`
    and `normal` are blended along the ray and `normal` is unit, away from the surface; `opacity` is the share
    of the ray that the surface stops; `concentration` is the share of the blending weight that lies close to
    `position` (1 for a host with a sharp surface), which tells a hit from a miss and from an average over two
    surfaces. The normal of a miss is zero.
    """

    color: Float[Tensor, "N 3"]
    position: Float[Tensor, "N 3"]
    normal: Float[Tensor, "N 3"]
    opacity: Float[Tensor, " N"]
    concentration: Float[Tensor, " N"]

    def is_hit(self, share: float) -> Bool[Tensor, " N"]:
        """Which rays meet one surface: at least `share` of their weight lies close to the hit."""
        return self.concentration >= share


@dataclass(frozen=True)
class Material(Indexable):
    """Simplified Disney parameters at a point, each in [0, 1]; `roughness` r has microfacet width r²."""

    base_color: Float[Tensor, "N 3"]
    roughness: Float[Tensor, "N 1"]
    metallic: Float[Tensor, "N 1"]


@dataclass(frozen=True)
class IncidentSamples(Indexable):
    """Directions towards the light with the density that drew them.

    `wi` points away from the surface. `pdf` is per steradian and is that of the whole set, so that the mean
    over S of f(wi)/pdf(wi) estimates the integral of f over the hemisphere, whatever the sampler. A direction
    below the horizon is allowed; the shading gives it no weight. Directions that all points share have N = 1.
    """

    wi: Float[Tensor, "N S 3"]
    pdf: Float[Tensor, "N S"]


class Source(IntEnum):
    """Where incident light comes from, as `Incident.source` numbers it; lamp k is `LAMPS` + k."""

    LIGHT = 0
    SCENE = 1
    LAMPS = 2


@dataclass(frozen=True)
class Incident(Indexable):
    """Light that arrives at N points along S directions.

    `radiance` is linear; `weight` is the solid angle that a direction stands for, steradians, so that the sum
    over S of weight · radiance · f · cos is the estimate of the rendering equation; `source` is a `Source`,
    or more for a lamp.
    """

    wi: Float[Tensor, "N S 3"]
    radiance: Float[Tensor, "N S 3"]
    weight: Float[Tensor, "N S"]
    source: Int[Tensor, "N S"]

    @staticmethod
    def of(
        drawn: IncidentSamples, radiance: Float[Tensor, "#N S 3"], source: Int[Tensor, "N S"] | None = None
    ) -> Incident:
        """What arrives along drawn directions, 1/(S · pdf) each. No `source`: all from the light."""
        weight = 1 / (drawn.pdf.clamp_min(PDF_FLOOR) * drawn.pdf.shape[1])
        if source is None:
            source = torch.zeros((), dtype=torch.long, device=weight.device).expand(weight.shape)
        return Incident(drawn.wi, radiance, weight, source)

    def beside(self, other: Incident) -> Incident:
        """The directions of both."""
        return Incident(
            *(torch.cat((getattr(self, f.name), getattr(other, f.name)), 1) for f in fields(self))
        )


@dataclass(frozen=True)
class Shading(Indexable):
    """Outgoing radiance of a point to the viewer and its parts: `color` = `diffuse` + `specular`."""

    color: Float[Tensor, "N 3"]
    diffuse: Float[Tensor, "N 3"]
    specular: Float[Tensor, "N 3"]


@dataclass(frozen=True)
class SceneLight(Indexable):
    """What the scene itself sends to N points from S directions: where a direction meets the scene, how far
    away, and the linear radiance that arrives from there. Where it meets nothing the distance is infinite and
    the radiance zero.
    """

    hit: Bool[Tensor, "N S"]
    radiance: Float[Tensor, "N S 3"]
    distance: Float[Tensor, "N S"]


SceneTracer = Callable[[Float[Tensor, "N 3"], Float[Tensor, "N S 3"]], SceneLight]
"""What the scene sends to points from directions."""


class LossTerm(NamedTuple):
    """A loss before reduction: `values` of any shape, and optional `weights` that broadcast to it.

    A named tuple: wrappers of data-parallel training find tensors there, not in frozen dataclasses.
    """

    values: Float[Tensor, ...]
    weights: Float[Tensor, ...] | Bool[Tensor, ...] | None = None

    def mean(self) -> Float[Tensor, ""]:
        """The weighted mean; 0, with a zero gradient, when nothing counts."""
        if self.weights is None:
            return self.values.mean() if self.values.numel() else self.values.sum()
        weights = self.weights.to(self.values.dtype).expand_as(self.values)
        return (self.values * weights).sum() / weights.sum().clamp_min(1e-6)


LossTerms = Mapping[str, LossTerm]


@dataclass(frozen=True)
class Observed(Indexable):
    """Surface points and their pixels: `pixel` in the capture's response, `wo` towards the camera."""

    position: Float[Tensor, "N 3"]
    normal: Float[Tensor, "N 3"]
    wo: Float[Tensor, "N 3"]
    pixel: Float[Tensor, "N 3"]


@dataclass(frozen=True)
class SurfacePixels(Observed):
    """Surface points, what an image holds of each, and how fast that changes from pixel to pixel."""

    image_gradient: Float[Tensor, " N"]

    @staticmethod
    def none_of(batch: PixelBatch) -> SurfacePixels:
        """No points, on the device of a batch."""
        nothing = batch.color[:0]
        return SurfacePixels(nothing, nothing, nothing, nothing, batch.image_gradient[:0])


class StepResult(NamedTuple):
    """What a training step computed: its losses, and constants for those who solve for the light.

    Wrappers of data-parallel training skip frozen dataclasses, so points travel as rows of tensors.

    Attributes:
        terms: the losses that count in the stage, before their weights.
        surface_rows: position, normal, wo and pixel of the surface points that the step rendered; none before
            the material stages.
        beyond_rows: direction and pixel of the rays that pass the scene by; none before the material stages.
    """

    terms: LossTerms
    surface_rows: Float[Tensor, "P 12"]
    beyond_rows: Float[Tensor, "Q 6"]

    @staticmethod
    def of(terms: LossTerms, surface: Observed, beyond: PixelBatch) -> StepResult:
        """The result of a step that rendered these surface points, and these pixels beyond the scene."""
        points = (surface.position, surface.normal, surface.wo, surface.pixel)
        pixels = (beyond.directions, beyond.color)
        return StepResult(terms, torch.cat(points, -1).detach(), torch.cat(pixels, -1))

    @property
    def surface(self) -> Observed:
        """The surface points that the step rendered, as they are shaded."""
        return Observed(*self.surface_rows.split(3, -1))


@dataclass(frozen=True)
class Maps:
    """Everything that rays show, one row a ray; colours are linear.

    Where a ray meets no surface, `rgb` is the host's colour and the material is 0.
    """

    rgb: Float[Tensor, "N 3"]
    rgb_volume: Float[Tensor, "N 3"]
    diffuse: Float[Tensor, "N 3"]
    specular: Float[Tensor, "N 3"]
    base_color: Float[Tensor, "N 3"]
    roughness: Float[Tensor, "N 1"]
    metallic: Float[Tensor, "N 1"]
    normal: Float[Tensor, "N 3"]
    depth: Float[Tensor, "N 1"]
    opacity: Float[Tensor, "N 1"]

    @staticmethod
    def of_host(rays: RayBatch, hits: SurfaceHits) -> Maps:
        """What the host alone says: no material anywhere."""
        color, parameter = torch.zeros_like(hits.color), torch.zeros_like(hits.color[:, :1])
        depth = ((hits.position - rays.origins) * rays.directions).sum(-1, keepdim=True)
        return Maps(
            rgb=hits.color,
            rgb_volume=hits.color,
            diffuse=color,
            specular=color,
            base_color=color,
            roughness=parameter,
            metallic=parameter,
            normal=hits.normal,
            depth=depth,
            opacity=hits.opacity[:, None],
        )
