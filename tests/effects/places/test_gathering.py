"""Places: means over their pixels, and the transport to these."""

from __future__ import annotations

import torch

from neilfpp_method.effects.places.data import DIRECTIONS, ROWS, place_transport
from neilfpp_method.effects.places.gathering import Places
from neilfpp_method.shading import LOBES
from neilfpp_method.structures import Observed, SceneLight
from tests.effects.balls import ball

LOBE = LOBES["spherical_gaussian"]


def test_means_are_computed_per_place():
    values = torch.tensor([1.0, 3.0, 5.0])
    nothing = Observed(*[torch.zeros(3, 3)] * 4)
    places = Places(3, torch.tensor([0, 0, 2]), torch.arange(3), nothing)
    assert places.mean(values).tolist() == [2.0, 0.0, 5.0]
    assert places.where(torch.tensor([1])).mean(values[1:2]).tolist() == [3.0, 0.0, 0.0]


def test_selected_places_all_have_pixels():
    place = torch.tensor([0, 0, 0, 2, 4, 4])
    rows = torch.arange(6.0)[:, None].expand(-1, 3)
    places = Places(5, place, torch.arange(6), Observed(*[rows] * 4))
    two = places.with_at_least(2)
    assert (two.count, two.place.tolist()) == (2, [0, 0, 0, 1, 1])
    assert two.observed.pixel[:, 0].tolist() == [0, 1, 2, 4, 5]
    first = places.first(4)
    assert (first.count, first.place.tolist()) == (2, [0, 0, 0, 1])
    assert places.only_shown().count == places.shown_count == 3


def test_rays_are_traced_once_per_place():
    one = torch.ones(40, 1)
    places = ball(0.5 * one.expand(-1, 3), 0.28 * one, 0 * one, LOBE)
    rays = []

    def scene(x: torch.Tensor, wi: torch.Tensor) -> SceneLight:
        rays.append(wi.shape[0] * wi.shape[1])
        up = wi[..., 2] > 0.5
        return SceneLight(up, up[..., None] * torch.ones(3), torch.where(up, 1.0, torch.inf))

    transport = place_transport(places, LOBE, scene)
    assert sum(rays) == DIRECTIONS * places.count * ROWS**2
    open_sky = place_transport(places, LOBE, None)
    assert transport.sources.sum() < open_sky.sources.sum()
    assert (transport.scene[0] > 0).any()
