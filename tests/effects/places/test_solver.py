"""Places from training steps, and an attached model that starts its light from them."""

from __future__ import annotations

import logging

import pytest
import torch

from neilfpp_method.attach import attach_neilf, pixel_batch
from neilfpp_method.effects.places import solver as place_solver
from neilfpp_method.effects.places.solver import PlaceSolver
from neilfpp_method.schedule import Stage, StagePosition
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
    solver = PlaceSolver("linear", print)
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
    solver = PlaceSolver("linear", print)
    assert solver.places().count == 0
    none = ball(*[torch.ones(1, n) for n in (3, 1, 1)], None).observed[:0]
    model = sphere_model(solved_light(tiny_config()))
    light_solver = model.light_solver()
    for step in range(place_solver.MAX_WAIT + 1):
        assert solver.is_waiting(light_solver)
        solver.before_step(model, light_solver, StagePosition(Stage.MATERIAL_INIT, step, 1000))
        solver.observe(none)
    solver.before_step(model, light_solver, StagePosition(Stage.MATERIAL_INIT, step, 1000))
    assert not solver.is_waiting(light_solver)
    assert solver.places().count == 0


def test_clipped_pixels_are_left_out_and_display_values_become_linear():
    observed = ball(*[0.5 * torch.ones(10, n) for n in (3, 1, 1)], None, VIEWS).observed
    solver = PlaceSolver("srgb", print)
    observed.pixel[:] = 0.5
    observed.pixel[:20] = 1.0
    solver.observe(observed)
    kept = solver.points.kept()[:, 9:]
    assert len(kept) == len(observed) - 20
    torch.testing.assert_close(kept, torch.full_like(kept, 0.2140), atol=1e-3, rtol=0)


@short_light_fits()
def test_an_attached_model_starts_from_an_initial_light_and_searches_materials(small_memory, caplog):
    """The map that it starts with is bright above."""
    config = solved_light(tiny_config())
    neilf = attach_neilf(BallHost(), config).train()
    optimizer = torch.optim.Adam(neilf.parameters(), lr=1e-3)
    steps = 60
    neilf.model.config.train.__dict__.update(sdf_steps=0, material_steps=steps, joint_steps=0)
    even = neilf.model.light.log_radiance.clone()
    with caplog.at_level(logging.WARNING):
        for step in range(steps):
            rays = ball_rays(256, 0.6, step)
            normal = neilf.model.host.render(rays).normal
            # A Lambertian ball under a light from above.
            color = 0.3 * (1.2 + normal[:, 2:]).expand(-1, 3).clamp_min(0.02)
            total = neilf.losses(pixel_batch(rays.origins, rays.directions, color), step)
            optimizer.zero_grad()
            total.loss.backward()
            optimizer.step()
            if neilf.places.is_waiting(neilf.light_solver):
                assert torch.equal(neilf.model.light.log_radiance, even)
    assert "initial light" in caplog.text
    assert "material search" in caplog.text
    assert not neilf.light_solver.seeks_start
    radiance = neilf.model.light.log_radiance.exp().mean(0)
    assert radiance[0].mean() > 1.2 * radiance[-1].mean()
