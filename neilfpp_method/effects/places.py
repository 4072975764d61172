"""Places on the surface, each with the pixels of all training views that show it: what tells materials apart
is how a place changes from view to view.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from neilfpp_method.data.pixels import PixelDataset
from neilfpp_method.data.views import project
from neilfpp_method.fields.exposure import at_mean_exposure
from neilfpp_method.model import NeilfModel
from neilfpp_method.shading.color import CLIPPED, srgb_to_linear
from neilfpp_method.structures import Observed

__all__ = ["Places", "gather_places"]

MIN_COSINE = 0.15
"""A pixel that shows a place at a flatter angle covers too much of what is beside it."""
MAX_OFFSET = 2.5
"""Distance, in pixels, at which a pixel still shows the same place."""
SAME_NORMAL = 0.9
"""Cosine between the normal at a place and at what a pixel shows of it."""


@dataclass(frozen=True)
class Places:
    """N pixels of `count` places.

    Attributes:
        count: how many places.
        place: of each pixel, from 0 to count − 1.
        view: of each pixel, in the order of the training views.
        observed: what each pixel shows: its own point of the surface, scene frame, and its linear radiance.
    """

    count: int
    place: Int[Tensor, " N"]
    view: Int[Tensor, " N"]
    observed: Observed

    def where(self, rows: Tensor) -> Places:
        """Some of the pixels; the places keep their numbers."""
        return Places(self.count, self.place[rows], self.view[rows], self.observed[rows])

    def in_views(self, least: int) -> Places:
        """Places that so many views show, or more."""
        views = torch.bincount(self.place, minlength=self.count)
        return self.where(torch.nonzero(views[self.place] >= least)[:, 0])

    def first(self, most: int) -> Places:
        """The first places, as many as have at most `most` pixels together."""
        total = torch.bincount(self.place, minlength=self.count).cumsum(0)
        return self.where(torch.nonzero(total[self.place] <= most)[:, 0])

    def mean(self, values: Float[Tensor, "N ..."]) -> Float[Tensor, "P ..."]:
        """Of each place; 0 for a place without a pixel."""
        sums = values.new_zeros(self.count, *values.shape[1:]).index_add(0, self.place, values)
        pixels = torch.bincount(self.place, minlength=self.count).clamp_min(1)
        return sums / pixels.view(-1, *[1] * (values.ndim - 1))


@torch.no_grad()
def gather_places(
    model: NeilfModel,
    pixels: PixelDataset,
    position: Float[Tensor, "P 3"],
    normal: Float[Tensor, "P 3"],
    views: int,
) -> Places:
    """The pixels that show given surface points, each in at most `views` randomly drawn views.

    Args:
        model: whose host says what a pixel shows.
        pixels: of the training views.
        position, normal: of the places, scene frame.
        views: bounds time and memory.
    """
    to_scene = pixels.capture.normalisation.camera
    cameras = [to_scene(view.camera) for view in pixels.views]
    chosen = torch.rand(len(position), len(cameras), device=position.device).argsort(1).argsort(1) < views
    found = []
    for number, camera in enumerate(cameras):
        shown = project(camera, position)
        column, row = shown.pixel.floor().long().unbind(-1)
        within = (
            (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height) & (shown.depth > 0)
        )
        place = torch.nonzero(within & chosen[:, number])[:, 0]
        if not len(place):
            continue
        batch = pixels.at(number, row[place] * camera.width + column[place])
        hits = model.host.render(batch.rays)
        away = (hits.position - position[place]).norm(dim=-1)
        shaded = model.shading_normals(hits.position, hits.normal)
        same = (
            hits.is_hit(model.config.shading.hit_share)
            & (batch.mask > 0.5)
            & pixels.valid(number)[row[place] * camera.width + column[place]]
            & (away < MAX_OFFSET * shown.depth[place] / camera.fx)
            & ((shaded * normal[place]).sum(-1) > SAME_NORMAL)
            & ((shaded * -batch.directions).sum(-1) > MIN_COSINE)
        )
        linear = at_mean_exposure(model.gains, batch.color, batch.view, model.facts.response)
        if model.facts.response == "srgb":
            same = same & (batch.color.amax(-1) < CLIPPED)
            linear = srgb_to_linear(linear)
        kept = torch.nonzero(same)[:, 0]
        observed = Observed(hits.position[kept], shaded[kept], -batch.directions[kept], linear[kept])
        found.append(Places(len(position), place[kept], torch.full_like(kept, number), observed))
    if not found:
        none = torch.zeros(0, dtype=torch.long, device=position.device)
        return Places(len(position), none, none, Observed(*[position[:0]] * 4))
    place, view = (torch.cat([getattr(part, name) for part in found]) for name in ("place", "view"))
    observed = Observed(
        *(
            torch.cat([getattr(part.observed, name) for part in found])
            for name in ("position", "normal", "wo", "pixel")
        )
    )
    return Places(len(position), place, view, observed)
