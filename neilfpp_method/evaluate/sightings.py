"""Find the training views that see a surface point, their directions, and their pixels of the point."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from neilfpp_method.data.cameras.projection import pixel_index, project
from neilfpp_method.data.capture import Capture
from neilfpp_method.data.pixels.dataset import PixelDataset
from neilfpp_method.fields.exposure import at_mean_exposure
from neilfpp_method.model import EVAL_RAYS, NeilfModel
from neilfpp_method.shading.color import CLIPPED
from neilfpp_method.structures import Indexable, PixelBatch, RayBatch

__all__ = ["Sightings", "TrainingViews"]

TOLERANCE = 0.05
"""Distance, scene units, within which two surface points count as the same; that of the hit criterion."""
MIN_COSINE = 0.05
"""Least cosine between view direction and normal. At grazing angles a pixel covers too large an area."""


@dataclass(frozen=True)
class Sightings(Indexable):
    """Observations of N points in up to V views.

    Attributes:
        visible: whether the entry holds a view.
        wo: unit direction to the camera; the normal if the entry holds no view.
        pixel: pixel of the view, at the mean exposure of the capture; 0 if the entry holds no view.
    """

    visible: Bool[Tensor, "N V"]
    wo: Float[Tensor, "N V 3"]
    pixel: Float[Tensor, "N V 3"]


class TrainingViews:
    """The training views of a capture, ordered so that the first few look from different sides.

    Args:
        capture: the capture.
        device: device that holds the pixels; points must be on it too.
    """

    def __init__(self, capture: Capture, device: torch.device | str = "cpu") -> None:
        self.hdr = capture.hdr
        self.pixels = PixelDataset(capture, capture.train_views, device)
        self.cameras = [capture.scene_camera(view) for view in capture.train_views]
        self.centers = torch.stack(
            [torch.as_tensor(camera.c2w[:, 3], dtype=torch.float32) for camera in self.cameras]
        ).to(device)
        self.order = _farthest_first(self.centers)

    def evenly_spaced_pixels(self, count: int) -> PixelBatch:
        """Return about `count` pixels of the object, evenly over and within the views. Deterministic."""
        each = max(1, count // len(self.cameras))
        batches = []
        for i in range(len(self.cameras)):
            view = self.pixels.view(i, gradients=False)
            rows = torch.nonzero((view.mask > 0.5) & self.pixels.valid(i))[:, 0]
            batches.append(view[rows[:: max(1, math.ceil(len(rows) / each))]])
        return PixelBatch.joined(batches)

    @torch.no_grad()
    def sightings(
        self, model: NeilfModel, position: Float[Tensor, "N 3"], normal: Float[Tensor, "N 3"], max_views: int
    ) -> Sightings:
        """Find views in which each point is unoccluded and its pixel is valid, on the object and not clipped.

        The first `max_views` such views in `order` are returned.
        """
        visible = torch.zeros(len(position), max_views, dtype=torch.bool, device=position.device)
        wo = normal[:, None].repeat(1, max_views, 1)
        pixel = torch.zeros_like(wo)
        for i in self.order:
            rows = torch.nonzero(~visible.all(1))[:, 0]
            if not len(rows):
                break
            view = self.pixels.view(i, gradients=False)
            index = pixel_index(project(self.cameras[i], position[rows]), self.cameras[i])
            usable = (view.mask > 0.5) & self.pixels.valid(i) & (self.hdr | (view.color < CLIPPED).all(-1))
            to_camera = self.centers[i] - position[rows]
            distance = to_camera.norm(dim=-1)
            direction = to_camera / distance[:, None]
            kept = (index >= 0) & usable[index] & ((direction * normal[rows]).sum(-1) > MIN_COSINE)
            rows, direction, distance, index = rows[kept], direction[kept], distance[kept], index[kept]
            unoccluded = _unoccluded(model, self.centers[i], position[rows], direction, distance)
            rows, index = rows[unoccluded], index[unoccluded]
            slot = visible[rows].sum(1)
            visible[rows, slot], wo[rows, slot] = True, direction[unoccluded]
            pixel[rows, slot] = at_mean_exposure(
                model.gains, view.color[index], view.view[index], model.facts.response
            )
        return Sightings(visible, wo, pixel)


def _unoccluded(
    model: NeilfModel,
    center: Float[Tensor, " 3"],
    position: Float[Tensor, "N 3"],
    direction: Float[Tensor, "N 3"],
    distance: Float[Tensor, " N"],
) -> Bool[Tensor, " N"]:
    """Whether nothing lies between surface points and a camera.

    If the model traces light through the scene, the same tracer is used; otherwise the host is rendered.
    """
    scene, share = model.scene, model.config.shading.hit_share
    if scene is not None:
        return scene(position, direction[:, None]).distance[:, 0] >= distance - TOLERANCE
    unoccluded = torch.zeros_like(distance, dtype=torch.bool)
    for rows in torch.arange(len(distance), device=distance.device).split(EVAL_RAYS):
        hits = model.host.render(RayBatch(center.expand(len(rows), 3), -direction[rows]))
        unoccluded[rows] = hits.is_hit(share) & ((hits.position - position[rows]).norm(dim=-1) <= TOLERANCE)
    return unoccluded


def _farthest_first(centers: Float[Tensor, "C 3"]) -> list[int]:
    """Order in which each centre is the one farthest from all before it, starting with the first."""
    order = [0]
    distance = torch.full_like(centers[:, 0], torch.inf)
    while len(order) < len(centers):
        distance = torch.minimum(distance, (centers - centers[order[-1]]).norm(dim=-1))
        distance[order] = -1.0
        order.append(int(distance.argmax()))
    return order
