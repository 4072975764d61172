"""Intersections of rays with a sphere, compared with closed forms."""

from __future__ import annotations

import math

import pytest
import torch

from neilfpp_method.volume.intersect import sphere_interval

X = [1.0, 0.0, 0.0]


@pytest.mark.parametrize(
    ("origin", "direction", "near", "far"),
    [
        ([-5.0, 0.0, 0.0], X, 3.0, 7.0),  # through the centre: 5 ∓ 2
        ([-5.0, 1.0, 0.0], X, 5.0 - math.sqrt(3.0), 5.0 + math.sqrt(3.0)),  # half chord √(2² − 1²)
        ([0.5, 0.0, 0.0], X, 0.0, 1.5),  # from the inside: only the exit
        ([0.0, 0.0, 0.0], [0.6, 0.0, 0.8], 0.0, 2.0),  # from the centre
        ([-5.0, 2.0, 0.0], X, 5.0, 5.0),  # tangent
    ],
)
def test_closed_forms(origin, direction, near, far):
    interval = sphere_interval(
        torch.tensor([origin], dtype=torch.float64), torch.tensor([direction], dtype=torch.float64), 2.0
    )
    assert interval.near.item() == pytest.approx(near, abs=1e-12)
    assert interval.far.item() == pytest.approx(far, abs=1e-12)


@pytest.mark.parametrize("origin", [[-5.0, 2.5, 0.0], [5.0, 0.0, 0.0], [5.0, 2.5, 0.0]])
def test_a_miss_and_a_sphere_behind_have_no_length(origin):
    interval = sphere_interval(torch.tensor([origin]), torch.tensor([X]), 2.0)
    assert interval.near.item() == interval.far.item() >= 0.0


def test_the_ends_lie_on_the_sphere_for_far_cameras():
    torch.manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(256, 3), dim=-1)
    inside = torch.nn.functional.normalize(torch.randn(256, 3), dim=-1) * 1.9
    interval = sphere_interval(inside - 1000.0 * directions, directions, 2.0)
    for distance in (interval.near, interval.far):
        ends = inside.double() + (distance.double() - 1000.0)[:, None] * directions.double()
        assert (ends.norm(dim=-1) - 2.0).abs().max() < 2e-3  # float32 at 1000 is accurate to 6e-5
