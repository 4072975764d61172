"""Where rays hit, compared with planes and with surfaces one behind the other."""

from __future__ import annotations

import pytest
import torch

from neilfpp_method.volume.compositing import depth_weights, sample_weights
from neilfpp_method.volume.density import entering_depth
from neilfpp_method.volume.hits import near_median, share_near, surface_depth


def test_the_share_near_a_depth_takes_parts_of_intervals():
    distances, weights = torch.tensor([[0.0, 1.0, 3.0, 3.0, 4.0]]), torch.tensor([[0.1, 0.4, 0.0, 0.3]])
    near = share_near(distances, weights, torch.tensor([2.0]), 1.5)  # from 0.5 to 3.5
    assert near.item() == pytest.approx(0.5 * 0.1 + 0.4 + 0.5 * 0.3)
    assert share_near(distances, weights, torch.tensor([9.0]), 1.5).item() == 0.0


@pytest.mark.parametrize(("front", "near"), [(0.6, [1, 1, 0, 0]), (0.4, [0, 0, 1, 1])])
def test_the_samples_near_the_median_are_those_of_the_surface_with_the_larger_weight(front, near):
    distances = torch.tensor([[1.0, 1.02, 3.0, 3.02]])
    weights = torch.tensor([[front, 0.0, 1.0 - front]])
    # The opacity of a ray does not matter.
    for opacity in (1.0, 0.3):
        assert near_median(distances, opacity * weights, 0.05).tolist() == [near]


def test_the_ends_of_the_interval_of_the_median_are_near_however_wide_it_is():
    distances = torch.tensor([[1.0, 2.0, 2.04, 2.1, 4.0]])
    assert near_median(distances, torch.tensor([[1.0, 0, 0, 0]]), 0.05).tolist() == [[1, 1, 0, 0, 0]]
    assert near_median(distances, torch.tensor([[0, 1.0, 0, 0]]), 0.05).tolist() == [[0, 1, 1, 0, 0]]
    assert near_median(distances, torch.tensor([[0, 1.0, 0, 0]]), 0.2).tolist() == [[0, 1, 1, 1, 0]]
    assert near_median(distances, torch.zeros(1, 4), 0.05).tolist() == [[1, 1, 0, 0, 0]]  # an empty ray


def depth_of_plane(plane, cosine, beta=0.02):
    """Mean depth and `surface_depth` of a ray that meets a plane at depth `plane` at an angle."""
    distances = torch.linspace(0.5, 1.5, 400, dtype=plane.dtype)[None]
    sdf = cosine * (plane - distances)
    weights = sample_weights(depth_weights(entering_depth(sdf, torch.tensor(beta))).weights)
    slope = torch.full_like(sdf, -cosine)
    mean = (weights * distances).sum(-1) / weights.sum(-1)
    return mean, surface_depth(weights, distances, sdf, slope)


@pytest.mark.parametrize("beta", [0.002, 0.02])
@pytest.mark.parametrize("cosine", [1.0, 0.7, 0.31])
def test_the_depth_of_a_plane_is_that_of_its_zero_set(cosine, beta):
    plane = torch.tensor(1.0, dtype=torch.float64, requires_grad=True)
    mean, depth = depth_of_plane(plane, cosine, beta)
    assert mean.item() - 1.0 > 0.25 * beta / cosine
    assert depth.item() == pytest.approx(1.0, abs=2e-6)
    assert torch.autograd.grad(depth.sum(), plane)[0].item() == pytest.approx(1.0, rel=1e-3)


def test_at_a_grazing_angle_the_hit_moves_a_part_of_the_way():
    mean, depth = depth_of_plane(torch.tensor(1.0, dtype=torch.float64), cosine=0.15)
    assert 1.0 < depth.item() < mean.item()
    assert (mean - depth).item() == pytest.approx(0.5 * (mean.item() - 1.0), rel=1e-3)


def test_the_depth_of_an_empty_ray_is_that_of_its_last_sample():
    distances, none = torch.tensor([[1.0, 2.0, 3.0]]), torch.zeros(1, 3)
    assert surface_depth(none, distances, torch.ones(1, 3), -torch.ones(1, 3)).item() == 3.0


@pytest.mark.parametrize(
    ("sdf", "slope", "expected"), [(-5.0, -1.0, 1.0), (0.5, -1.0, 2.0), (-0.1, 1.0, 2.0 - 0.1 / 0.3)]
)
def test_a_hit_lies_between_the_samples_of_its_ray(sdf, slope, expected):
    """Deep in fog, where it passes a surface, and where G rises along the ray."""
    distances, weights = torch.tensor([[1.0, 2.0, 3.0]]), torch.tensor([[0.0, 0.5, 0.0]])
    depth = surface_depth(weights, distances, torch.full((1, 3), sdf), torch.full((1, 3), slope))
    assert depth.item() == pytest.approx(expected, rel=1e-4)
