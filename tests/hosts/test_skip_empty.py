"""The VolSDF host with rays that skip empty space: where they do, and that a checkpoint holds all of it."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from neilfpp_method.hosts.volsdf import VolSdfHost
from neilfpp_method.volume import empty_space
from tests.scenes import sphere_batch, tiny_config


def host(skip: bool = True) -> VolSdfHost:
    torch.manual_seed(0)
    config = tiny_config()
    return VolSdfHost(dataclasses.replace(config, volume=dataclasses.replace(config.volume, skip_empty=skip)), 3.0, "constant")


@pytest.fixture(autouse=True)
def _coarse(monkeypatch):
    monkeypatch.setattr(empty_space, "RESOLUTION", 24)


def test_evaluation_takes_whole_rays():
    skipping, plain = host().eval(), host(skip=False).eval()
    plain.load_state_dict(skipping.state_dict(), strict=False)
    rays = sphere_batch().rays
    torch.manual_seed(1)
    found = skipping.render(rays)
    torch.manual_seed(1)
    assert torch.equal(found.position, plain.render(rays).position)
    assert skipping.empty_space.age is None


def test_training_skips_and_ages_as_the_geometry_moves():
    skipping = host().train()
    for _ in range(3):
        skipping.render_regularised(sphere_batch(), ())
    assert skipping.empty_space.age == 3
    with torch.no_grad():
        skipping.render_regularised(sphere_batch(), ())
    assert skipping.empty_space.age == 3  # nothing moved


def test_hits_stay_where_they_are():
    skipping, plain = host().train(), host(skip=False).train()
    rays = sphere_batch().rays
    one, other = skipping.render(rays), plain.render(rays)
    solid = (one.opacity > 0.99) & (other.opacity > 0.99)
    assert solid.sum() > 5
    assert (one.position - other.position)[solid].norm(dim=-1).median() < 0.03


def test_a_checkpoint_goes_on_with_the_same_grid():
    first = host().train()
    first.render_regularised(sphere_batch(), ())
    second = host().train()
    with torch.no_grad():
        for parameter in second.parameters():
            parameter.zero_()
    second.load_state_dict(first.state_dict())
    torch.manual_seed(5)
    one = first.render(sphere_batch().rays)
    torch.manual_seed(5)
    other = second.render(sphere_batch().rays)
    assert torch.equal(one.position, other.position)
    assert second.empty_space.age == 1
