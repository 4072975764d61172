"""Which training views see a surface point, from where, and what they hold of it."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from neilfpp_method.data.capture import Capture
from neilfpp_method.data.pixels import PixelDataset
from neilfpp_method.data.views import Camera, project
from neilfpp_method.fields.exposure import at_mean_exposure
from neilfpp_method.model import NeilfModel
from neilfpp_method.structures import Indexable, PixelBatch, RayBatch

__all__ = ["Sightings", "TrainingViews"]

TOLERANCE = 0.05
"""Distance, scene units, within which two surfaces count as one, as for a hit."""
MIN_COSINE = 0.05
"""Flatter views are left out: a pixel then covers much surface."""


@dataclass(frozen=True)
class Sightings(Indexable):
    """N points as up to V views see them; without a view `wo` is the normal and the pixel black."""

    seen: Bool[Tensor, "N V"]
    wo: Float[Tensor, "N V 3"]
    pixel: Float[Tensor, "N V 3"]


class TrainingViews:
    """The training views of a capture, ordered such that the first few look from all around.

    Args:
        capture: where the views come from.
        device: where the pixels are kept, and points are looked for.
    """

    def __init__(self, capture: Capture, device: torch.device | str = "cpu") -> None:
        self.hdr = capture.hdr
        self.pixels = PixelDataset(capture, capture.train_views, device)
        self.cameras = [capture.normalisation.camera(view.camera) for view in capture.train_views]
        self.centres = torch.stack(
            [torch.as_tensor(camera.c2w[:, 3], dtype=torch.float32) for camera in self.cameras]
        ).to(device)
        self.order = _far_from_one_another(self.centres)

    def evenly(self, count: int) -> PixelBatch:
        """About `count` pixels of the object, evenly over the views and over each; the same at every call."""
        each = max(1, count // len(self.cameras))
        batches = []
        for i in range(len(self.cameras)):
            view = self.pixels.view(i, gradients=False)
            rows = torch.nonzero((view.mask > 0.5) & self.pixels.valid(i))[:, 0]
            batches.append(view[rows[:: max(1, math.ceil(len(rows) / each))]])
        return PixelBatch(
            **{f.name: torch.cat([getattr(batch, f.name) for batch in batches]) for f in fields(PixelBatch)}
        )

    @torch.no_grad()
    def sightings(
        self, model: NeilfModel, position: Float[Tensor, "N 3"], normal: Float[Tensor, "N 3"], most: int
    ) -> Sightings:
        """The first views, `most` at most, in which nothing hides a point and whose pixel there can be used:
        it is valid, on the object, and not clipped.
        """
        seen = torch.zeros(len(position), most, dtype=torch.bool, device=position.device)
        wo = normal[:, None].repeat(1, most, 1)
        pixel = torch.zeros_like(wo)
        for i in self.order:
            rows = torch.nonzero(~seen.all(1))[:, 0]
            if not len(rows):
                break
            view, index = (
                self.pixels.view(i, gradients=False),
                _pixel_numbers(self.cameras[i], position[rows]),
            )
            usable = (view.mask > 0.5) & self.pixels.valid(i) & (self.hdr | (view.color < 1).all(-1))
            towards = self.centres[i] - position[rows]
            distance = towards.norm(dim=-1)
            direction = towards / distance[:, None]
            kept = (index >= 0) & usable[index] & ((direction * normal[rows]).sum(-1) > MIN_COSINE)
            rows, direction, distance, index = rows[kept], direction[kept], distance[kept], index[kept]
            free = _nothing_between(model, self.centres[i], position[rows], direction, distance)
            rows, slot, index = rows[free], seen[rows[free]].sum(1), index[free]
            seen[rows, slot], wo[rows, slot] = True, direction[free]
            pixel[rows, slot] = at_mean_exposure(
                model.gains, view.color[index], view.view[index], model.facts.response
            )
        return Sightings(seen, wo, pixel)


def _nothing_between(
    model: NeilfModel,
    centre: Float[Tensor, " 3"],
    position: Float[Tensor, "N 3"],
    direction: Float[Tensor, "N 3"],
    distance: Float[Tensor, " N"],
) -> Bool[Tensor, " N"]:
    """Whether a camera sees surface points within its picture: traced as light is, or rendered."""
    scene, share = model.scene, model.config.shading.hit_share
    if scene is not None:
        return scene(position, direction[:, None]).distance[:, 0] >= distance - TOLERANCE
    free = torch.zeros_like(distance, dtype=torch.bool)
    for rows in torch.arange(len(free), device=free.device).split(model.config.train.eval_chunk):
        hits = model.host.render(RayBatch(centre.expand(len(rows), 3), -direction[rows]))
        free[rows] = hits.is_hit(share) & ((hits.position - position[rows]).norm(dim=-1) <= TOLERANCE)
    return free


def _pixel_numbers(camera: Camera, position: Float[Tensor, "N 3"]) -> Int[Tensor, " N"]:
    """Which pixel of a camera points are in, counted row by row; −1 outside of its picture."""
    at = project(camera, position)
    size = at.pixel.new_tensor([camera.width, camera.height])
    inside = (at.depth > 0) & ((at.pixel >= 0) & (at.pixel < size)).all(-1)
    column, row = torch.where(inside[:, None], at.pixel, 0.0).long().unbind(-1)
    return torch.where(inside, row * camera.width + column, -1)


def _far_from_one_another(centres: Float[Tensor, "C 3"]) -> list[int]:
    """An order in which each centre is as far as can be from all before it; the first is the first."""
    order = [0]
    distance = torch.full_like(centres[:, 0], torch.inf)
    while len(order) < len(centres):
        distance = torch.minimum(distance, (centres - centres[order[-1]]).norm(dim=-1))
        distance[order] = -1.0
        order.append(int(distance.argmax()))
    return order
