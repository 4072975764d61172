"""Surface points that are shaded again: while a surface stands still, no ray need be rendered twice."""

from __future__ import annotations

import torch
from torch import nn

from neilfpp_method.lighting.ring import Ring
from neilfpp_method.structures import SurfacePixels

__all__ = ["Replay"]

KEPT_STEPS = 16
"""Points are kept for the rays of so many steps."""
WIDTHS = (3, 3, 3, 3, 1)


class Replay(nn.Module):
    """The newest surface points of a stage in which no surface moves. It is part of a checkpoint.

    Args:
        fresh: share of the points of a step that are new, once there are enough to draw from; 1: nothing is
            kept.
        rays: of a step.
    """

    def __init__(self, fresh: float, rays: int) -> None:
        super().__init__()
        self.fresh = fresh
        self.ring = Ring(KEPT_STEPS * rays if fresh < 1 else 0, sum(WIDTHS))

    @property
    def share(self) -> float:
        """Of the rays of the next step, those that are to be rendered."""
        return self.fresh if self.ring.full else 1.0

    def beside_earlier(self, surface: SurfacePixels) -> SurfacePixels:
        """The points of a step, constants, and as many of earlier steps as make them `share` of all."""
        if self.fresh == 1:
            return surface
        new = surface.detach()
        rows = torch.cat((new.position, new.normal, new.wo, new.pixel, new.image_gradient[:, None]), -1)
        earlier = self.ring.draw(round(len(rows) * (1 / self.share - 1)))
        self.ring.keep(rows)
        *vectors, image_gradient = torch.cat((rows, earlier.to(rows.dtype))).split(WIDTHS, -1)
        return SurfacePixels(*vectors, image_gradient[:, 0])
