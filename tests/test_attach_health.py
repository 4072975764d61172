"""Steps that are not finite, and missing surfaces, in a training loop outside of the package."""

from __future__ import annotations

import dataclasses
import logging

import pytest
import torch

from neilfpp_method.attach import attach_neilf, pixel_batch
from neilfpp_method.errors import Diverged
from neilfpp_method.structures import PixelBatch
from tests.hosts.balls import Ball, BallHost, ball_rays
from tests.scenes import tiny_config


def pixels(seed: int = 0) -> PixelBatch:
    rays = ball_rays(64, 0.3, seed)
    return pixel_batch(rays.origins, rays.directions, torch.tensor([[0.4, 0.2, 0.1]]).expand(64, 3))


def material_steps(count: int):
    config = tiny_config()
    train = dataclasses.replace(config.train, sdf_steps=0, material_steps=count, joint_steps=0)
    return dataclasses.replace(config, train=train)


def attached(host: object, steps: int = 40):
    """The parts of a guarded training loop."""
    torch.manual_seed(0)
    neilf = attach_neilf(host, material_steps(steps))
    optimizer = torch.optim.Adam(neilf.param_groups(), betas=(0.9, 0.99))
    neilf.guard(optimizer)
    return neilf, optimizer


def step(neilf, optimizer, number: int, spoil: float = 1.0) -> None:
    optimizer.zero_grad()
    (spoil * neilf.losses(pixels(number), number).loss).backward()
    optimizer.step()


def test_a_step_that_is_not_finite_changes_nothing_and_is_logged(caplog):
    neilf, optimizer = attached(Ball())
    step(neilf, optimizer, 0)
    before = [p.detach().clone() for p in neilf.parameters()]
    with caplog.at_level(logging.WARNING):
        step(neilf, optimizer, 1, spoil=torch.nan)
    assert all(torch.equal(p, q) for p, q in zip(neilf.parameters(), before, strict=True))
    assert [r.message for r in caplog.records if "skipped" in r.message] == [
        "step 1 skipped: the gradient of brdf is not finite (1 skipped so far)"
    ]
    step(neilf, optimizer, 2)
    assert not all(torch.equal(p, q) for p, q in zip(neilf.parameters(), before, strict=True))


def test_ten_such_steps_in_a_row_end_the_training():
    neilf, optimizer = attached(Ball())
    for number in range(9):
        step(neilf, optimizer, number, spoil=torch.nan)
    with pytest.raises(Diverged):
        step(neilf, optimizer, 9, spoil=torch.nan)
    assert neilf.step_guard.skipped == 10


def test_the_health_of_a_surface_needs_no_rendering():
    asked = []

    class Counted(Ball):
        def forward(self, origins, directions):
            asked.append(len(origins))
            return super().forward(origins, directions)

    neilf, optimizer = attached(Counted(), steps=3)
    for number in range(3):
        step(neilf, optimizer, number)
    before = len(asked)
    assert str(neilf.health()) == "sound"
    assert len(asked) == before


def test_fog_is_reported_at_the_end_of_the_stage(caplog):
    def fog(rays, outputs):
        ones = torch.ones_like(rays.origins[:, 0])
        return {"opacity": ones, "concentration": 0.1 * ones}

    neilf, optimizer = attached(BallHost(fog), steps=3)
    with caplog.at_level(logging.WARNING):
        for number in range(3):
            step(neilf, optimizer, number)
    assert neilf.health().verdict == "failed"
    assert sum("the scene is fog" in r.message for r in caplog.records) == 1


def test_before_the_first_step_nothing_is_known():
    neilf, _ = attached(Ball())
    assert neilf.health().findings == ()
