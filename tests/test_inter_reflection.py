"""Hard inter-reflection in full and in part, under a light and beside a wall that are known in closed form."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from torch.nn.functional import normalize

from neilfpp_method.facts import SceneFacts
from neilfpp_method.inter_reflection import before_light, traced_in_part
from neilfpp_method.model import NeilfModel
from neilfpp_method.schedule import Stage
from neilfpp_method.structures import RayBatch, SceneLight, SurfaceHits
from tests.scenes import meet_ball, sphere_batch, tiny_config

WALL, SKY = 0.3, 2.0


class Wall:
    """All directions with x > 0 meet a wall that sends `WALL`; counts the directions that are traced."""

    def __init__(self) -> None:
        self.traced = 0

    def __call__(self, x: torch.Tensor, wi: torch.Tensor) -> SceneLight:
        self.traced += wi[..., 0].numel()
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

    arriving = before_light(Wall()(None, wi), light, torch.zeros(3, 3), wi)
    torch.testing.assert_close(arriving, torch.where(wi[..., :1] > 0, torch.full_like(wi, WALL), sky(None, wi)))
    assert (torch.cat(asked) <= 0).all()


@pytest.mark.parametrize("share", [0.1, 0.5])
def test_a_part_of_the_rays_has_the_mean_of_all(share):
    wi, wall = directions(1, 20), Wall()
    many = 4000
    torch.manual_seed(0)
    drawn = traced_in_part(wall, sky, torch.zeros(many, 3), wi.expand(many, -1, -1), share)
    assert wall.traced == many * 20 * share
    expected = before_light(wall(None, wi), sky, torch.zeros(1, 3), wi)[0]
    error = drawn.std(0) / math.sqrt(many)
    assert ((drawn.mean(0) - expected).abs() <= 5 * error + 1e-5).all()
    assert error.max() > 0


def test_all_of_the_rays_are_no_estimate():
    wi, wall = directions(4, 30), Wall()
    x = torch.zeros(4, 3)
    torch.testing.assert_close(traced_in_part(wall, sky, x, wi, 1.0), before_light(wall(x, wi), sky, x, wi))


class Sphere:
    """A host: an opaque unit sphere at the centre of the scene; counts the rays that it renders."""

    def __init__(self) -> None:
        self.rays = 0

    def render(self, rays: RayBatch) -> SurfaceHits:
        self.rays += len(rays)
        position, met = meet_ball(rays, 1.0)
        return SurfaceHits(torch.full_like(position, 0.5), position, normalize(position, dim=-1), met, met)


def test_a_step_traces_the_share_that_is_set_and_a_picture_traces_all():
    config = tiny_config()
    rays = {}
    for share in (1.0, 0.25):
        settings = dataclasses.replace(config.inter_reflection, mode="hard", traced_share=share)
        light = dataclasses.replace(config.light, kind="distant", map="known.exr")
        changed = dataclasses.replace(config, inter_reflection=settings, light=light)
        model = NeilfModel(Sphere(), changed, SceneFacts("linear", 0.2, 3.0, "constant"))
        batch = sphere_batch()
        model.losses(batch, Stage.MATERIAL_INIT)
        rays[share] = model.host.rays - len(batch)
        model.eval().host.rays = 0
        model.maps(batch.rays)
        rays["picture", share] = model.host.rays
    assert rays[0.25] == rays[1.0] / 4 > 0
    assert rays["picture", 0.25] == rays["picture", 1.0]
