"""Surface points are not rendered twice while the geometry is fixed."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from neilfpp_method.lighting import replay
from neilfpp_method.lighting.replay import PointReplay
from neilfpp_method.model import NeilfModel
from neilfpp_method.schedule import Stage
from neilfpp_method.structures import SurfacePixels
from tests.scenes import sphere_batch, sphere_model, tiny_config
from tests.test_model import count_queries

RAYS = 4800
"""Number of rays, large enough that a quarter of them has about the same share of hits."""
QUARTER = dataclasses.replace(tiny_config().train, fresh=0.25, rays=RAYS)


@pytest.fixture(autouse=True)
def short(monkeypatch):
    """A replay buffer that is full after a few steps."""
    monkeypatch.setattr(replay, "KEPT_STEPS", 1)


def model(**changes) -> NeilfModel:
    off = dataclasses.replace(tiny_config().light, inter_reflection="off")
    # The weights along a ray of the initial sphere are spread out, because its layer is soft.
    soft = dataclasses.replace(tiny_config().shading, hit_share=0.5)
    return sphere_model(tiny_config(train=dataclasses.replace(QUARTER, **changes), light=off, shading=soft))


def filled(**changes) -> NeilfModel:
    stepping = model(**changes)
    for _ in range(6):
        stepping.losses(sphere_batch(RAYS), Stage.MATERIAL_INIT)
    return stepping


def test_with_a_full_buffer_a_quarter_is_rendered_and_as_many_points_are_shaded():
    before, after = model(), filled()
    all_new = count_queries(before, lambda: before.losses(sphere_batch(RAYS), Stage.MATERIAL_INIT))
    some_new = count_queries(after, lambda: after.losses(sphere_batch(RAYS), Stage.MATERIAL_INIT))
    assert (all_new["rays"], some_new["rays"]) == (RAYS, RAYS // 4)
    assert some_new["brdf"] == pytest.approx(all_new["brdf"], rel=0.2)


@pytest.mark.parametrize("where", ["the surface moves", "nothing is trained", "it is switched off"])
def test_every_ray_is_rendered_without_replay(where):
    other = filled(fresh=1.0) if where == "it is switched off" else filled()
    other.train(where != "nothing is trained")
    stage = Stage.JOINT if where == "the surface moves" else Stage.MATERIAL_INIT
    assert count_queries(other, lambda: other.losses(sphere_batch(RAYS), stage))["rays"] == RAYS


def test_points_of_a_borrowed_host_are_not_replayed():
    own = filled()
    assert NeilfModel(own.host, own.config, own.facts, borrowed=True).replay.fresh == 1


def test_replayed_points_keep_their_pixels():
    """All values of a point are derived from one number, which identifies it."""
    torch.manual_seed(0)
    memory = PointReplay(0.25, 40)

    def numbered(values: torch.Tensor) -> SurfacePixels:
        column = values[:, None].expand(-1, 3)
        return SurfacePixels(column, column + 0.1, column + 0.2, column + 0.3, values + 0.4)

    for start in (0, 20):
        given = memory.with_earlier(numbered(torch.arange(start, start + 20.0)))
        assert len(given) == 20
    together = memory.with_earlier(numbered(torch.arange(40.0, 50.0)))
    assert len(together) == 40
    number = together.position[:, 0]
    assert number[:10].tolist() == list(range(40, 50))
    assert number[10:].max() < 40
    expected = numbered(number)
    for name in ("position", "normal", "wo", "pixel", "image_gradient"):
        torch.testing.assert_close(getattr(together, name), getattr(expected, name))


def test_a_resumed_run_draws_the_same_points():
    one, other = filled(), model()
    other.load_state_dict(one.state_dict())
    losses = []
    for each in (one, other):
        torch.manual_seed(7)
        losses.append(each.losses(sphere_batch(RAYS), Stage.MATERIAL_INIT)["physical"].values)
    assert torch.equal(*losses)
