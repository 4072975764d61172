"""Hard inter-reflection, under a light and beside a wall that are known in closed form."""

from __future__ import annotations

import math

import torch
from torch.nn.functional import normalize

from neilfpp_method.inter_reflection import before_light
from neilfpp_method.structures import SceneLight

WALL, SKY = 0.3, 2.0


def wall(wi: torch.Tensor) -> SceneLight:
    """All directions with x > 0 meet a wall that sends `WALL`."""
    hit = wi[..., 0] > 0
    return SceneLight(hit, torch.where(hit[..., None], WALL, 0.0).expand(wi.shape), torch.where(hit, 1.0, math.inf))


def sky(x: torch.Tensor, wi: torch.Tensor) -> torch.Tensor:
    return SKY * (1.5 + wi[..., 2:]).expand(wi.shape)


def directions(points: int, count: int) -> torch.Tensor:
    return normalize(torch.randn(points, count, 3, generator=torch.Generator().manual_seed(0)), dim=-1)


def test_the_light_is_asked_where_nothing_is_in_the_way_alone():
    wi, asked = directions(3, 50), []

    def light(x, wi):
        asked.append(wi[..., 0])
        return sky(x, wi)

    arriving = before_light(wall(wi), light, torch.zeros(3, 3), wi)
    torch.testing.assert_close(arriving, torch.where(wi[..., :1] > 0, torch.full_like(wi, WALL), sky(None, wi)))
    assert (torch.cat(asked) <= 0).all()
