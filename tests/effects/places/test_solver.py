"""Places from training steps, and an attached model that starts its light from them."""

from __future__ import annotations

import logging

import pytest
import torch

from neilfpp_method.attach import AttachedNeilf, attach_neilf, pixel_batch
from neilfpp_method.effects.places import solver as place_solver
from neilfpp_method.effects.places.solver import PlaceSolver
from neilfpp_method.effects.plan import Plan
from neilfpp_method.effects.request import parse_effects
from neilfpp_method.errors import UserError
from neilfpp_method.schedule import Stage, StagePosition
from neilfpp_method.settings.plain import changed
from neilfpp_method.settings.types import NeilfConfig
from neilfpp_method.shading import LOBES
from tests.effects.balls import ball
from tests.hosts.balls import BallHost, ball_rays
from tests.scenes import sphere_model, tiny_config
from tests.train.small_runs import short_light_fits, solved_light

COUNT, VIEWS = 200, 8


@pytest.fixture
def small_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(place_solver, "PIXELS", COUNT * VIEWS)
    monkeypatch.setattr(place_solver, "PLACES", COUNT)


def test_neighbouring_points_of_the_same_side_are_a_place(small_memory):
    color, one = torch.full((COUNT, 3), 0.5), torch.ones(COUNT, 1)
    observed = ball(color, 0.4 * one, 0 * one, LOBES["ggx"], VIEWS).observed
    solver = PlaceSolver(as_set(), "linear", print)
    for start in range(0, len(observed), 100):
        assert not solver.points.full
        solver.observe(observed[start : start + 100])
    assert solver.points.full
    places = solver.places()
    assert len(places.place.unique()) > COUNT // 4
    assert torch.bincount(places.place)[places.place].min() >= place_solver.MIN_PIXELS
    # A ball of radius 1 with 200 places: neighbours are about 0.1 apart.
    center = places.mean(places.observed.position)
    assert (places.observed.position - center[places.place]).norm(dim=-1).median() < 0.2


def test_an_empty_solver_has_no_places():
    solver = PlaceSolver(as_set(), "linear", print)
    assert solver.places().count == 0
    none = ball(*[torch.ones(1, n) for n in (3, 1, 1)], None).observed[:0]
    model = sphere_model(solved_light(tiny_config()))
    light_solver = model.light_solver()
    for step in range(place_solver.MAX_WAIT + 1):
        assert solver.is_waiting(light_solver)
        solver.before_step(model, light_solver, StagePosition(Stage.MATERIAL_INIT, step, 1000), step)
        solver.observe(none)
    solver.before_step(model, light_solver, StagePosition(Stage.MATERIAL_INIT, step, 1000), step)
    assert not solver.is_waiting(light_solver)
    assert solver.places().count == 0


def test_nothing_is_compared_before_the_light_has_started(monkeypatch):
    compared = []
    monkeypatch.setattr(place_solver, "improve", lambda *arguments: compared.append(arguments))
    solver = PlaceSolver(as_set(), "linear", print)
    model = sphere_model(solved_light(tiny_config()))
    light_solver, length = model.light_solver(), place_solver.MAX_WAIT // 2
    for step in range(length):
        assert solver.is_waiting(light_solver)
        solver.before_step(model, light_solver, StagePosition(Stage.MATERIAL_INIT, step, length), step)
    assert not compared


def test_clipped_pixels_are_left_out_and_display_values_become_linear():
    observed = ball(*[0.5 * torch.ones(10, n) for n in (3, 1, 1)], None, VIEWS).observed
    solver = PlaceSolver(as_set(), "srgb", print)
    observed.pixel[:] = 0.5
    observed.pixel[:20] = 1.0
    solver.observe(observed)
    kept = solver.points.kept()[:, 9:]
    assert len(kept) == len(observed) - 20
    torch.testing.assert_close(kept, torch.full_like(kept, 0.2140), atol=1e-3, rtol=0)


def as_set() -> Plan:
    return Plan.begin(parse_effects("as-set"), tiny_config())


def train_on_a_lambertian_ball(neilf: AttachedNeilf, steps: int) -> None:
    """Train `neilf` on a ball of one colour under a light that is brighter above."""
    optimizer = torch.optim.Adam(neilf.parameters(), lr=1e-3)
    even = neilf.model.light.log_radiance.clone()
    for step in range(steps):
        rays = ball_rays(256, 0.6, step)
        normal = neilf.model.host.render(rays).normal
        color = 0.3 * (1.2 + normal[:, 2:]).expand(-1, 3).clamp_min(0.02)
        total = neilf.losses(pixel_batch(rays.origins, rays.directions, color), step)
        optimizer.zero_grad()
        total.loss.backward()
        optimizer.step()
        if neilf.places.is_waiting(neilf.light_solver):
            assert torch.equal(neilf.model.light.log_radiance, even)


def ball_config(steps: int) -> NeilfConfig:
    stages = {"train.sdf_steps": 0, "train.material_steps": steps, "train.joint_steps": 0}
    return changed(solved_light(tiny_config()), stages)


@short_light_fits()
def test_an_attached_model_starts_from_an_initial_light_and_searches_materials(small_memory, caplog):
    """The map that it starts with is bright above."""
    neilf = attach_neilf(BallHost(), ball_config(60), effects="as-set").train()
    with caplog.at_level(logging.WARNING):
        train_on_a_lambertian_ball(neilf, 60)
    assert "initial light" in caplog.text
    assert "material search" in caplog.text
    assert "effects: metals" not in caplog.text
    assert not neilf.light_solver.seeks_start
    radiance = neilf.model.light.log_radiance.exp().mean(0)
    assert radiance[0].mean() > 1.2 * radiance[-1].mean()


@short_light_fits()
def test_evidence_leaves_out_what_a_lambertian_ball_lacks(small_memory, caplog):
    """A ball occludes nothing and has no metal; a checkpoint keeps both decisions."""
    neilf = attach_neilf(BallHost(), ball_config(60)).train()
    assert neilf.plan.is_open("metals")
    assert neilf.plan.is_open("inter-reflection")
    with caplog.at_level(logging.WARNING):
        train_on_a_lambertian_ball(neilf, 45)
    assert "effects: metals off" in caplog.text
    assert "effects: inter-reflection off" in caplog.text
    assert not neilf.model.brdf.metals
    assert neilf.model.scene is None

    resumed = attach_neilf(BallHost(), ball_config(60))
    resumed.load_state_dict(neilf.state_dict())
    assert resumed.plan.decisions == neilf.plan.decisions
    assert not resumed.model.brdf.metals
    assert resumed.model.config == neilf.model.config


def test_effects_of_an_attached_model_are_chosen_by_name():
    neilf = attach_neilf(BallHost(), ball_config(60), effects="auto,-metals")
    assert not neilf.model.brdf.metals
    with pytest.raises(UserError, match=r"no effect 'metal'.*did you mean 'metals'"):
        attach_neilf(BallHost(), ball_config(60), effects="-metal")
