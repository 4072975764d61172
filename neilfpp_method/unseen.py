"""What places send that no camera has looked at. R is a guess there, and the rendering equation knows better."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from neilfpp_method.hosts.base import Host
from neilfpp_method.structures import RayBatch, SceneLight

__all__ = ["SeenPlaces", "shade_unseen"]

CELLS = 64
"""Cells along an edge of the scene's cube."""
LIFE = 2**16
"""Places are unseen where none of so many hits of camera rays came down: some ten for every cell of a surface in view."""
MOST = 1 / 32
"""Of all directions, those that are shaded at most; beyond it chance decides, and R is taken for the others."""
BACK = 0.1
"""From where a place is looked at again, scene units before it: hosts that trace a grid know it to about a cell."""

ShadeAt = Callable[[Float[Tensor, "K 3"], Float[Tensor, "K 3"], Float[Tensor, "K 3"]], Float[Tensor, "K 3"]]
"""Position, normal and wo of surface points → the radiance that leaves them."""


class SeenPlaces(nn.Module):
    """Where rays of cameras have met a surface lately, by the cells of a grid. It is part of a checkpoint.

    A place counts as seen within a cell of such a hit, on either side of a thin wall; and everything does until as many hits
    are known as a place is remembered for.

    Args:
        radius: of the scene.
    """

    def __init__(self, radius: float) -> None:
        super().__init__()
        self.radius = radius
        self.hits = 0
        self.register_buffer("latest", torch.full((CELLS**3,), -LIFE, dtype=torch.int64))

    @torch.no_grad()
    def remember(self, x: Float[Tensor, "N 3"]) -> None:
        """Camera rays met a surface here; the nearest eight cells count."""
        self.hits += len(x)
        half = torch.tensor([-1.0, 1.0], device=x.device, dtype=x.dtype) * (self.radius / CELLS)
        around = torch.cartesian_prod(half, half, half)
        self.latest[self._cells(x[:, None] + around)] = self.hits

    @torch.no_grad()
    def unseen(self, x: Float[Tensor, "*B 3"]) -> Bool[Tensor, "*B"]:
        """Whether no camera has looked at points of surfaces, for all that is known."""
        if self.hits < LIFE:
            return torch.zeros_like(x[..., 0], dtype=torch.bool)
        return self.hits - self.latest[self._cells(x)] > LIFE

    def _cells(self, x: Float[Tensor, "*B 3"]) -> Int[Tensor, "*B"]:
        """The number of the cell that a point lies in, or the nearest to it."""
        at = (x / self.radius + 1) * (CELLS / 2)
        i, j, k = at.nan_to_num().floor().long().clamp(0, CELLS - 1).unbind(-1)
        return (k * CELLS + j) * CELLS + i

    def get_extra_state(self) -> dict[str, int]:
        """How many hits there were, for checkpoints."""
        return {"hits": self.hits}

    def set_extra_state(self, state: dict[str, int]) -> None:
        """The inverse of `get_extra_state`."""
        self.hits = state["hits"]


def shade_unseen(
    scene: SceneLight,
    x: Float[Tensor, "N 3"],
    wi: Float[Tensor, "N S 3"],
    seen: SeenPlaces,
    host: Host,
    hit_share: float,
    shade_at: ShadeAt,
) -> SceneLight:
    """What the scene sends, with what leaves unseen places by the rendering equation in the place of R (METHOD §1).

    Args:
        scene: what arrives at x from wi, by R: linear radiance, and distances in scene units.
        x, wi: surface points, scene frame, and unit directions away from them.
        seen: where cameras have looked.
        host: renders a ray to every place that is shaded, for its normal.
        hit_share: least concentration of a hit.
        shade_at: the radiance gets its gradient.
    """
    point, direction = torch.nonzero(scene.hit, as_tuple=True)
    towards, distance = wi[point, direction], scene.distance[point, direction]
    hidden = torch.nonzero(seen.unseen(x[point] + distance[:, None] * towards))[:, 0]
    hidden = hidden[torch.randperm(len(hidden), device=x.device)[: max(1, round(MOST * scene.hit.numel()))]]
    if not len(hidden):
        return scene
    point, direction, towards, distance = point[hidden], direction[hidden], towards[hidden], distance[hidden]
    with torch.no_grad():
        start = x[point] + (distance - BACK).clamp_min(0.5 * BACK)[:, None] * towards
        hits = host.render(RayBatch(start, towards))
    met = torch.nonzero(hits.is_hit(hit_share))[:, 0]
    radiance = shade_at(hits.position[met], hits.normal[met], -towards[met])
    at = (point[met], direction[met])
    return replace(scene, radiance=scene.radiance.index_put(at, radiance.to(scene.radiance.dtype)))
