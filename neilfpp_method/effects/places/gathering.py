"""Surface places, each with the pixels of the training views that show it.

Materials are distinguished by the change of a place's pixels from view to view.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from neilfpp_method.data.cameras.projection import pixel_index, project
from neilfpp_method.data.pixels.dataset import PixelDataset
from neilfpp_method.fields.exposure import at_mean_exposure
from neilfpp_method.lighting.layered_transport import SharedPoints
from neilfpp_method.model import NeilfModel
from neilfpp_method.shading.color import CLIPPED, srgb_to_linear
from neilfpp_method.shading.frame import safe_normalize
from neilfpp_method.structures import Observed, OrientedPoints

__all__ = ["Places", "Split", "gather_places"]

MIN_COSINE = 0.15
"""Minimum cosine between normal and viewing direction. At flatter angles a pixel covers too much of the
surroundings of the place.
"""
MAX_OFFSET = 2.5
"""Maximum distance between a place and the hit of a pixel that is assigned to it, in pixels."""
SAME_NORMAL = 0.9
"""Minimum cosine between the normal at a place and at the hit of a pixel that is assigned to it."""

Part = TypeVar("Part")


@dataclass(frozen=True)
class Split(Generic[Part]):
    """What belongs to the views to which models are fitted, and what belongs to the held-back views."""

    known: Part
    held_back: Part


@dataclass(frozen=True)
class Places:
    """N pixels of `count` places.

    Attributes:
        count: number of places.
        place: number of the place that each pixel shows, from 0 to count − 1.
        view: index of the training view of each pixel.
        observed: the surface point that each pixel shows, scene frame, and its linear radiance.
    """

    count: int
    place: Int[Tensor, " N"]
    view: Int[Tensor, " N"]
    observed: Observed

    @property
    def shown_count(self) -> int:
        """Number of places that have pixels."""
        return len(self.place.unique())

    def where(self, rows: Tensor) -> Places:
        """The same places with only some of the pixels."""
        return Places(self.count, self.place[rows], self.view[rows], self.observed[rows])

    def with_at_least(self, min_pixels: int) -> Places:
        """The places that have at least `min_pixels` pixels, numbered from 0."""
        pixels = torch.bincount(self.place, minlength=self.count)
        return self.where(torch.nonzero(pixels[self.place] >= min_pixels)[:, 0]).only_shown()

    def first(self, max_pixels: int) -> Places:
        """The first places that have at most `max_pixels` pixels together, numbered from 0."""
        total = torch.bincount(self.place, minlength=self.count).cumsum(0)
        return self.where(torch.nonzero(total[self.place] <= max_pixels)[:, 0]).only_shown()

    def only_shown(self) -> Places:
        """The places that have pixels, numbered from 0."""
        numbers, place = self.place.unique(return_inverse=True)
        return Places(len(numbers), place, self.view, self.observed)

    def mean(self, values: Float[Tensor, "N ..."]) -> Float[Tensor, "P ..."]:
        """Mean of values over the pixels of each place; 0 for a place without pixels."""
        sums = values.new_zeros(self.count, *values.shape[1:]).index_add(0, self.place, values)
        pixels = torch.bincount(self.place, minlength=self.count).clamp_min(1)
        return sums / pixels.view(-1, *[1] * (values.ndim - 1))

    def mean_if_shown(self, values: Float[Tensor, " N"]) -> Float[Tensor, " P"]:
        """The same, but NaN for a place without pixels."""
        has_pixels = torch.bincount(self.place, minlength=self.count) > 0
        return torch.where(has_pixels, self.mean(values), torch.nan)

    def fold_rows(self, fold: int, folds: int) -> Split[Tensor]:
        """Indices of the pixels of each part of the views.

        Args:
            fold: the fold of the views that is held back, from 0 to `folds` − 1.
            folds: number of folds.
        """
        is_held_back = self.view % folds == fold
        return Split(torch.nonzero(~is_held_back)[:, 0], torch.nonzero(is_held_back)[:, 0])

    def shared_points(self) -> SharedPoints:
        """One point per place, the mean of the points that its pixels show, from which rays are traced."""
        position, normal = self.mean(self.observed.position), self.mean(self.observed.normal)
        return SharedPoints(position, safe_normalize(normal), self.observed, self.place)


@torch.no_grad()
def gather_places(
    model: NeilfModel,
    pixels: PixelDataset,
    position: Float[Tensor, "P 3"],
    normal: Float[Tensor, "P 3"],
    views: int,
) -> Places:
    """Collect the pixels that show given surface points, at most one per point and view.

    Args:
        model: its host renders the surface point of each pixel.
        pixels: the training pixels.
        position: positions of the places, scene frame.
        normal: unit normals of the places.
        views: maximum number of randomly drawn views per place; it bounds time and memory.
    """
    drawn = torch.rand(len(position), len(pixels.views), device=position.device)
    is_chosen = drawn.argsort(1).argsort(1) < views
    points = OrientedPoints(position, normal)
    parts = [
        _in_view(model, pixels, points, number, is_chosen[:, number]) for number in range(len(pixels.views))
    ]
    parts = [part for part in parts if part is not None]
    if not parts:
        none = torch.zeros(0, dtype=torch.long, device=position.device)
        return Places(len(position), none, none, Observed(*[position[:0]] * 4))
    place, view = torch.cat([part.place for part in parts]), torch.cat([part.view for part in parts])
    return Places(len(position), place, view, Observed.joined([part.observed for part in parts]))


def _in_view(
    model: NeilfModel,
    pixels: PixelDataset,
    points: OrientedPoints,
    number: int,
    is_chosen: Bool[Tensor, " P"],
) -> Places | None:
    """The pixels of one view that show the chosen points; None if none of these lies in the image."""
    camera = pixels.capture.scene_camera(pixels.views[number])
    projected = project(camera, points.position)
    index = pixel_index(projected, camera)
    place = torch.nonzero((index >= 0) & is_chosen)[:, 0]
    if not len(place):
        return None
    position, normal = points.position[place], points.normal[place]
    pixel = index[place]
    batch = pixels.at(number, pixel)
    hits = model.host.render(batch.rays)
    distance = (hits.position - position).norm(dim=-1)
    hit_normal = model.shading_normals(hits.position, hits.normal)
    same = (
        hits.is_hit(model.config.shading.hit_share)
        & (batch.mask > 0.5)
        & pixels.valid(number)[pixel]
        & (distance < MAX_OFFSET * projected.depth[place] / camera.fx)
        & ((hit_normal * normal).sum(-1) > SAME_NORMAL)
        & ((hit_normal * -batch.directions).sum(-1) > MIN_COSINE)
    )
    linear = at_mean_exposure(model.gains, batch.color, batch.view, model.facts.response)
    if model.facts.response == "srgb":
        same = same & (batch.color.amax(-1) < CLIPPED)
        linear = srgb_to_linear(linear)
    rows = torch.nonzero(same)[:, 0]
    observed = Observed(hits.position[rows], hit_normal[rows], -batch.directions[rows], linear[rows])
    return Places(len(points), place[rows], torch.full_like(rows, number), observed)
