"""A buffer of surface points that are shaded again in later steps, used while geometry is fixed.

As long as the surface does not change, the hit of a ray does not change either, so rendering it once is
enough.
"""

from __future__ import annotations

import math

import torch
from torch import nn

from neilfpp_method.lighting.ring import Ring
from neilfpp_method.structures import SurfacePixels

__all__ = ["PointReplay"]

KEPT_STEPS = 16
"""Capacity of the buffer, in steps of rays."""
WIDTHS = (3, 3, 3, 3, 1)
"""Numbers per row: position, normal, `wo`, pixel, and image gradient."""


class PointReplay(nn.Module):
    """The newest surface points of a stage with fixed geometry. Its state is part of a checkpoint.

    Args:
        fresh: share of the points of a step that are newly rendered, once the buffer is full; with 1 nothing
            is stored.
        rays: number of rays in a step.
    """

    def __init__(self, fresh: float, rays: int) -> None:
        super().__init__()
        self.fresh = fresh
        self.ring = Ring(KEPT_STEPS * rays if fresh < 1 else 0, sum(WIDTHS))

    @property
    def share(self) -> float:
        """Share of the rays of the next step that must be rendered."""
        return self.fresh if self.ring.full else 1.0

    def rows_to_render(self, rays: int) -> slice:
        """The first rows of a batch, which must be rendered; stored points stand in for the other rows."""
        return slice(math.ceil(self.share * rays))

    def with_earlier(self, surface: SurfacePixels) -> SurfacePixels:
        """The points of a step together with stored points of earlier steps, without gradients.

        The new points make up `share` of the result, and are stored in turn. If `fresh` is 1, the result is
        `surface` itself, with its gradients.
        """
        if self.fresh == 1:
            return surface
        new = surface.detach()
        rows = torch.cat((new.position, new.normal, new.wo, new.pixel, new.image_gradient[:, None]), -1)
        earlier = self.ring.draw(round(len(rows) * (1 / self.share - 1)))
        self.ring.keep(rows)
        *vectors, image_gradient = torch.cat((rows, earlier.to(rows.dtype))).split(WIDTHS, -1)
        return SurfacePixels(*vectors, image_gradient[:, 0])
