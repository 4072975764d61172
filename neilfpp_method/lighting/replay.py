"""Surface points that are shaded again: while a surface stands still, no ray need be rendered twice."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from neilfpp_method.lighting.memory import Observed
from neilfpp_method.lighting.ring import Ring

__all__ = ["Replay", "SurfacePixels"]

KEPT_STEPS = 16
"""Points are kept for the rays of so many steps."""
WIDTHS = (3, 3, 3, 3, 1)


@dataclass(frozen=True)
class SurfacePixels(Observed):
    """Surface points, what an image holds of each, and how fast that changes from pixel to pixel."""

    image_gradient: Float[Tensor, " N"]


class Replay(nn.Module):
    """The newest surface points of a stage in which no surface moves. It is part of a checkpoint.

    Args:
        fresh: share of the points of a step that are new, once there are enough to draw from.
        rays: of a step.
    """

    def __init__(self, fresh: float, rays: int) -> None:
        super().__init__()
        self.fresh = fresh
        self.ring = Ring(KEPT_STEPS * rays, sum(WIDTHS))

    @property
    def share(self) -> float:
        """Of the rays of the next step, those that are to be rendered."""
        return self.fresh if self.ring.full else 1.0

    def beside_earlier(self, seen: SurfacePixels) -> SurfacePixels:
        """The points of a step, constants, and as many of earlier steps as make them `share` of all."""
        seen = seen.detach()
        rows = torch.cat((seen.position, seen.normal, seen.wo, seen.pixel, seen.image_gradient[:, None]), -1)
        earlier = self.ring.draw(round(len(rows) * (1 / self.share - 1)))
        self.ring.keep(rows)
        *vectors, image_gradient = torch.cat((rows, earlier.to(rows.dtype))).split(WIDTHS, -1)
        return SurfacePixels(*vectors, image_gradient[:, 0])
