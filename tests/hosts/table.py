"""A ball on a round table in closed form: the truth with which a proxy is compared."""

from __future__ import annotations

import math

import torch
from torch.nn.functional import normalize

from neilfpp_method.structures import RayBatch

CENTER, RADIUS = (0.1, 0.0, 0.05), 0.35
TABLE, REACH = -0.3, 0.9
"""Height of the table, and its radius."""


class TableTop:
    """A function host; `lift` raises the whole scene, like a host that changes."""

    def __init__(self, lift: float = 0.0) -> None:
        self.lift = lift
        self.asked = 0

    def meet(self, origins: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
        """The distance to the first surface, infinite without a hit."""
        center = torch.tensor(CENTER) + torch.tensor([0.0, 0.0, self.lift])
        from_center = origins - center
        middle = -(from_center * directions).sum(-1)
        square = middle.square() - from_center.square().sum(-1) + RADIUS**2
        near = middle - square.clamp_min(0).sqrt()
        ball = torch.where((square > 0) & (near > 1e-4), near, torch.inf)
        down = (TABLE + self.lift - origins[:, 2]) / directions[:, 2]
        flat = (origins + down[:, None] * directions)[:, :2].norm(dim=-1)
        table = torch.where((down > 1e-4) & (flat < REACH), down, torch.inf)
        return torch.minimum(ball, table)

    def __call__(self, origins: torch.Tensor, directions: torch.Tensor) -> tuple[torch.Tensor, ...]:
        assert len(origins) > 0
        self.asked += len(origins)
        distance = self.meet(origins, directions)
        hit = distance.isfinite()
        position = origins + torch.where(hit, distance, 0.0)[:, None] * directions
        center = torch.tensor(CENTER) + torch.tensor([0.0, 0.0, self.lift])
        on_ball = (position - center).norm(dim=-1) < RADIUS + 1e-3
        normal = torch.where(
            on_ball[:, None], normalize(position - center, dim=-1), torch.tensor([0.0, 0.0, 1.0])
        )
        color = torch.where(on_ball[:, None], torch.tensor([0.6, 0.1, 0.1]), torch.tensor([0.2, 0.3, 0.4]))
        return color * hit[:, None], position, normal * hit[:, None]


def camera_rays_above(count: int, seed: int = 0) -> RayBatch:
    """Rays from cameras around and above the table, to points on it and near it."""
    generator = torch.Generator().manual_seed(seed)
    azimuth = 2 * math.pi * torch.rand(count, generator=generator)
    height = torch.rand(count, generator=generator) * 1.2 + 0.5
    origins = torch.stack((2.5 * azimuth.cos(), 2.5 * azimuth.sin(), height), -1)
    aims = (2 * torch.rand(count, 3, generator=generator) - 1) * torch.tensor([0.9, 0.9, 0.4])
    return RayBatch(origins, normalize(aims - origins, dim=-1))
