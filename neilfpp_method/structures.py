"""Data structures that the modules of the package exchange.

N is the number of rays or surface points, S the number of incident directions per point. Positions are in the
scene frame (the object lies in the unit sphere, see docs/conventions.md), directions are unit vectors in that
frame, and radiance is linear RGB.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from enum import IntEnum
from typing import ClassVar, NamedTuple, TypeVar

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
"""Lower bound on a pdf before dividing by it, per steradian. Directions whose density is below it make up
less than 2π · 1e-6 of what a sampler draws, so the estimate is not changed noticeably.
"""

Structure = TypeVar("Structure", bound="Indexable")


class Indexable:
    """Base of dataclasses whose tensors share their first axis.

    `structure[rows]`, `structure.to(device)` and `structure.detach()` apply to every tensor; `len(structure)`
    is the number of rows.
    """

    @staticmethod
    def joined(parts: Sequence[Structure]) -> Structure:
        """The rows of all parts, of which there is at least one, in order."""
        first, *others = parts
        return first.map_named(
            lambda name, rows: torch.cat([rows, *(getattr(other, name) for other in others)])
        )

    def map_named(self: Structure, function: Callable[[str, Tensor], Tensor]) -> Structure:
        """Replace every tensor by `function(name, tensor)`."""
        tensors = {f.name: getattr(self, f.name) for f in fields(self)}
        return replace(
            self, **{name: function(name, t) for name, t in tensors.items() if isinstance(t, Tensor)}
        )

    def map(self: Structure, function: Callable[[Tensor], Tensor]) -> Structure:
        """Replace every tensor by `function(tensor)`."""
        return self.map_named(lambda name, tensor: function(tensor))

    def __getitem__(self: Structure, rows: Tensor | slice) -> Structure:
        return self.map(lambda t: t[rows])

    def to(self: Structure, device: torch.device | str) -> Structure:
        return self.map(lambda t: t.to(device, non_blocking=True))

    def detach(self: Structure) -> Structure:
        return self.map(Tensor.detach)

    def __len__(self) -> int:
        return getattr(self, fields(self)[0].name).shape[0]


@dataclass(frozen=True)
class RayBatch(Indexable):
    """Rays in the scene frame. `directions` are unit vectors: ray parameters are distances in scene units."""

    origins: Float[Tensor, "N 3"]
    directions: Float[Tensor, "N 3"]


@dataclass(frozen=True)
class PixelBatch(Indexable):
    """Pixels of the training images with their camera rays.

    Attributes:
        origins, directions: the camera ray of each pixel, scene frame.
        color: pixel values: linear radiance for an HDR capture, on one scale for all views; display values
            (sRGB) for an LDR capture.
        mask: 1 on the object, 0 off it. Meaningful only where `mask_known` is positive.
        mask_known: weight of the mask. 1 everywhere if the capture has masks. Without masks it is
            `data.pixels.dataset.BACKGROUND_TRUST` at pixels that show exactly the background colour, and 0
            at all others, whose `mask` is 1.
        image_gradient: length of the gradient of the image's luminance by Scharr's filter without
            normalization, that is 32 times the change per pixel; 0 if no loss needs it.
        view: index of the training view.
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
    """Surface points and their outward unit normals, in the scene frame."""

    position: Float[Tensor, "P 3"]
    normal: Float[Tensor, "P 3"]


@dataclass(frozen=True)
class SurfaceHits(Indexable):
    """What a host renders for each ray.

    Attributes:
        color: linear radiance of the whole ray, background included.
        position: hit position, blended from samples of the ray with their rendering weights.
        normal: outward unit normal, blended in the same way; zero for a miss.
        opacity: sum of the rendering weights, in [0, 1].
        concentration: share of the rendering weight that lies close to `position`; 1 for a hit of a sharp
            surface. A low value means a miss or an average over two surfaces.
    """

    color: Float[Tensor, "N 3"]
    position: Float[Tensor, "N 3"]
    normal: Float[Tensor, "N 3"]
    opacity: Float[Tensor, " N"]
    concentration: Float[Tensor, " N"]

    def is_hit(self, share: float) -> Bool[Tensor, " N"]:
        """Which rays hit a single surface: at least `share` of their weight lies close to `position`."""
        return self.concentration >= share


@dataclass(frozen=True)
class Material(Indexable):
    """Parameters of the simplified Disney BRDF, each in [0, 1]. Roughness r means microfacet width α = r²."""

    base_color: Float[Tensor, "N 3"]
    roughness: Float[Tensor, "N 1"]
    metallic: Float[Tensor, "N 1"]


@dataclass(frozen=True)
class IncidentSamples(Indexable):
    """Sampled incident directions and their density.

    `wi` points away from the surface. `pdf`, per steradian, is the density of the whole sample set, so for
    every sampler the mean over S of f(wi)/pdf(wi) estimates the integral of f over the hemisphere. Directions
    below the horizon are allowed: shading gives them weight 0. N is 1 if all points share their directions.
    """

    wi: Float[Tensor, "N S 3"]
    pdf: Float[Tensor, "N S"]


class Source(IntEnum):
    """Values of `Incident.source`: where incident light comes from. Lamp k has the value `LAMPS` + k."""

    LIGHT = 0
    SCENE = 1
    LAMPS = 2


@dataclass(frozen=True)
class Incident(Indexable):
    """Light that arrives at N surface points along S directions.

    Attributes:
        wi: incident directions, away from the surface.
        radiance: linear incident radiance.
        weight: solid angle that each direction stands for, steradians. The sum over S of
            weight · radiance · f · cos θ estimates the rendering equation.
        source: a `Source`; lamp k has `Source.LAMPS` + k.
    """

    wi: Float[Tensor, "N S 3"]
    radiance: Float[Tensor, "N S 3"]
    weight: Float[Tensor, "N S"]
    source: Int[Tensor, "N S"]

    @staticmethod
    def of(
        drawn: IncidentSamples, radiance: Float[Tensor, "#N S 3"], source: Int[Tensor, "N S"] | None = None
    ) -> Incident:
        """Incident light along sampled directions, each with weight 1/(S · pdf).

        Args:
            drawn: the sampled directions with their pdf.
            radiance: linear incident radiance.
            source: origin of each sample; if None, `Source.LIGHT` for all.
        """
        weight = 1 / (drawn.pdf.clamp_min(PDF_FLOOR) * drawn.pdf.shape[1])
        if source is None:
            source = torch.zeros((), dtype=torch.long, device=weight.device).expand(weight.shape)
        return Incident(drawn.wi, radiance, weight, source)

    def concatenate(self, other: Incident) -> Incident:
        """Concatenate the directions of both, for the same N points."""
        return Incident(
            *(torch.cat((getattr(self, f.name), getattr(other, f.name)), 1) for f in fields(self))
        )


@dataclass(frozen=True)
class Shading(Indexable):
    """Outgoing radiance towards the viewer, `color` = `diffuse` + `specular`, linear RGB."""

    color: Float[Tensor, "N 3"]
    diffuse: Float[Tensor, "N 3"]
    specular: Float[Tensor, "N 3"]


@dataclass(frozen=True)
class SceneLight(Indexable):
    """Light that the scene's own surfaces send to N points along S directions.

    Attributes:
        hit: whether the ray from the point along the direction meets a surface.
        radiance: linear radiance that arrives from there; 0 without a hit.
        distance: distance from the point to the surface, scene units; infinite without a hit. It is measured
            from the point itself, also if the ray starts above it, so that it compares with that of a lamp.
    """

    hit: Bool[Tensor, "N S"]
    radiance: Float[Tensor, "N S 3"]
    distance: Float[Tensor, "N S"]


SceneTracer = Callable[[Float[Tensor, "N 3"], Float[Tensor, "N S 3"]], SceneLight]
"""Traces rays from surface points x along directions wi and returns the light from the scene's surfaces."""


class LossTerm(NamedTuple):
    """A loss before reduction: `values` of any shape, and optional `weights` that broadcast to it.

    This is a named tuple because the wrappers of data-parallel training look for tensors in tuples, but not
    in frozen dataclasses.
    """

    values: Float[Tensor, ...]
    weights: Float[Tensor, ...] | Bool[Tensor, ...] | None = None

    def mean(self) -> Float[Tensor, ""]:
        """The weighted mean; 0 with a zero gradient if there are no values or all weights are 0."""
        if self.weights is None:
            return self.values.mean() if self.values.numel() else self.values.sum()
        weights = self.weights.to(self.values.dtype).expand_as(self.values)
        return (self.values * weights).sum() / weights.sum().clamp_min(1e-6)


LossTerms = Mapping[str, LossTerm]
"""Loss terms by name."""


@dataclass(frozen=True)
class Observed(Indexable):
    """Surface points with the pixels that show them.

    `wo` points towards the camera; `pixel` is the pixel value in the capture's response (linear or sRGB).
    """

    WIDTH: ClassVar[int] = 12
    """Numbers per point in `rows`."""

    position: Float[Tensor, "N 3"]
    normal: Float[Tensor, "N 3"]
    wo: Float[Tensor, "N 3"]
    pixel: Float[Tensor, "N 3"]

    @staticmethod
    def of_rows(rows: Float[Tensor, "N 12"]) -> Observed:
        """The points that `rows` packed."""
        return Observed(*rows.split(3, -1))

    def rows(self) -> Float[Tensor, "N 12"]:
        """Position, normal, wo and pixel of each point, packed into a row."""
        return torch.cat((self.position, self.normal, self.wo, self.pixel), -1)


@dataclass(frozen=True)
class SurfacePixels(Observed):
    """Observed surface points with the image gradient of `PixelBatch` at their pixels."""

    image_gradient: Float[Tensor, " N"]

    @staticmethod
    def empty_like(batch: PixelBatch) -> SurfacePixels:
        """Zero surface points, with the device and dtype of a batch."""
        no_rows = batch.color[:0]
        return SurfacePixels(no_rows, no_rows, no_rows, no_rows, batch.image_gradient[:0])


class StepResult(NamedTuple):
    """What a training step computed: its losses, and constants from which the light is solved.

    Points are stored as rows of tensors because the wrappers of data-parallel training skip frozen
    dataclasses.

    Attributes:
        terms: the active losses of the stage, before their weights.
        surface_rows: the surface points that this step rendered (`Observed.rows`); no rows in a stage without
            material.
        background_rows: direction and pixel of the rays that miss the scene; no rows in a stage without
            material.
    """

    terms: LossTerms
    surface_rows: Float[Tensor, "P 12"]
    background_rows: Float[Tensor, "Q 6"]

    @staticmethod
    def of(terms: LossTerms, surface: Observed, background: PixelBatch) -> StepResult:
        """Pack loss terms, rendered surface points, and pixels whose rays miss the scene."""
        background_rows = torch.cat((background.directions, background.color), -1)
        return StepResult(terms, surface.rows().detach(), background_rows)

    @property
    def surface(self) -> Observed:
        """The surface points that this step rendered, with their shading normals."""
        return Observed.of_rows(self.surface_rows)


@dataclass(frozen=True)
class Maps(Indexable):
    """All maps of an image, one row per ray; colours are linear RGB.

    Attributes:
        rgb: colour by the rendering equation; equal to `rgb_volume` if the opacity is at most one half.
        rgb_volume: colour that the host renders.
        diffuse, specular: the two parts of the shaded radiance; 0 if the opacity is at most one half.
        base_color, roughness, metallic: the material, each in [0, 1], not multiplied by the opacity; 0 if the
            opacity is at most 0.01.
        normal: unit normal in the scene frame, as used for shading; the host's blended normal where there is
            no material.
        depth: distance of the hit along the ray, scene units.
        opacity: sum of the rendering weights, in [0, 1].
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
        """Maps from the host's output only: `rgb` is its colour, and there is no material."""
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

    def with_rows(self, rows: Int[Tensor, " M"], **values: Float[Tensor, "M _"]) -> Maps:
        """The same maps, with other values at some rows of the named maps."""
        put = {k: getattr(self, k).index_put((rows,), v.to(self.rgb.dtype)) for k, v in values.items()}
        return replace(self, **put)
