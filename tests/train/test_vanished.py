"""A surface that has vanished is restored; others are left alone."""

from __future__ import annotations

import pytest
import torch

from neilfpp_method.schedule import Stage, StagePosition
from neilfpp_method.train.vanished import RESTORED_SHARE, STEPS_BETWEEN_CHECKS, restore_surface
from tests.hosts.balls import BallHost
from tests.scenes import sphere_batch, sphere_model

DUE = StagePosition(Stage.SDF_INIT, STEPS_BETWEEN_CHECKS, 10 * STEPS_BETWEEN_CHECKS)


def test_a_vanished_surface_is_restored_once():
    host = sphere_model().host
    host.sdf_field.lower_(-1.0)
    batch = sphere_batch(200)
    assert float(host.render(batch.rays).opacity.detach().max()) < 1e-3
    assert restore_surface(host, DUE)
    assert float(host.render(batch.rays).opacity.detach().max()) > 0.9
    points = torch.randn(20_000, 3)
    points = points / points.norm(dim=-1, keepdim=True) * torch.rand(20_000, 1) ** (1 / 3)
    assert float((host.sdf_field(points) < 0).float().mean()) == pytest.approx(RESTORED_SHARE, abs=0.02)
    assert not restore_surface(host, DUE)


def test_gradients_reach_geometry_again():
    host = sphere_model().host
    host.sdf_field.lower_(-1.0)
    for alive in (False, True):
        host.zero_grad()
        host.render(sphere_batch(100).rays).color.sum().backward()
        largest = max(float(p.grad.abs().max()) for p in host.sdf_field.parameters() if p.grad is not None)
        assert (largest > 1e-3) == alive
        restore_surface(host, DUE)


@pytest.mark.parametrize(
    "position",
    [
        StagePosition(Stage.SDF_INIT, STEPS_BETWEEN_CHECKS + 1, 10 * STEPS_BETWEEN_CHECKS),
        StagePosition(Stage.SDF_INIT, 6 * STEPS_BETWEEN_CHECKS, 10 * STEPS_BETWEEN_CHECKS),
        StagePosition(Stage.JOINT, STEPS_BETWEEN_CHECKS, 10 * STEPS_BETWEEN_CHECKS),
    ],
    ids=["between checks", "second half", "joint"],
)
def test_later_the_surface_is_left_alone(position):
    host = sphere_model().host
    host.sdf_field.lower_(-1.0)
    assert not restore_surface(host, position)


def test_a_present_surface_a_fitted_one_and_other_hosts_are_left_alone():
    host = sphere_model().host
    before = [p.clone() for p in host.parameters()]
    assert not restore_surface(host, DUE)
    host.starts_from_shape = True
    host.sdf_field.lower_(-1.0)
    assert not restore_surface(host, DUE)
    host.sdf_field.lower_(1.0)
    assert all(torch.allclose(a, b) for a, b in zip(before, host.parameters(), strict=True))
    assert not restore_surface(BallHost(), DUE)
