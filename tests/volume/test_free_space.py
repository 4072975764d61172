"""Free space around cameras: its size, its depth compared with the definition, and its effect on the
reference host.
"""

from __future__ import annotations

import dataclasses

import pytest
import torch

from neilfpp_method.hosts.volsdf import VolSdfHost
from neilfpp_method.settings.facts import SceneFacts
from neilfpp_method.structures import RayBatch
from neilfpp_method.volume.free_space import FreeSpace, free_balls
from tests.scenes import tiny_config

FACTS = SceneFacts("linear", 0.2, 3.0, "constant")


def ring(count: int, distance: float) -> torch.Tensor:
    angle = torch.arange(count) / count * 2 * torch.pi
    return distance * torch.stack([angle.cos(), angle.sin(), torch.zeros(count)], -1)


def shell(radius: float) -> torch.Tensor:
    """Points distributed over a sphere around the origin."""
    return radius * torch.nn.functional.normalize(
        torch.randn(20_000, 3, generator=torch.Generator().manual_seed(0)), dim=-1
    )


def test_no_ball_reaches_the_unit_sphere_and_none_is_larger_than_a_quarter_of_the_way():
    cameras = torch.linspace(0.0, 10.0, 1001)[:, None] * torch.tensor([0.0, 0.6, 0.8])
    balls = free_balls(cameras, None, radius=20.0)
    distance = balls.center.norm(dim=-1)
    assert distance.min() > 1.0, "cameras among the objects say nothing"
    assert (distance - balls.radius).min() >= 1.0 - 1e-6
    assert (balls.radius <= 0.25 * distance + 1e-6).all()
    assert free_balls(ring(1, 1.2), None, 1.75).radius.tolist() == pytest.approx([0.2])
    assert free_balls(ring(1, 2.0), None, 1.75).radius.tolist() == pytest.approx([0.5])


def test_points_determine_the_free_space():
    cameras = ring(6, 1.8)
    assert free_balls(cameras, shell(0.9), 1.75).radius == pytest.approx(
        torch.full((6,), 0.8 * 0.9), rel=0.02
    )
    assert free_balls(cameras, shell(0.3), 1.75).radius == pytest.approx(torch.full((6,), 0.8)), (
        "no ball reaches into the unit sphere"
    )
    stray = torch.cat([shell(0.9), cameras + 0.01])
    assert free_balls(cameras, stray, 1.75).radius.min() > 0.7, "stray points are left out"
    beside = torch.cat([shell(0.9), cameras[:1].repeat(300, 1) + 0.05])
    assert free_balls(cameras, beside, 1.75).radius.argmin() == 0
    assert free_balls(cameras, beside, 1.75).radius.min() < 0.1


def test_distant_cameras_do_not_change_the_scene():
    near, far = ring(6, 1.8), ring(6, 2.4)  # 2.4 − 0.6 = 1.8 lies beyond the scene sphere
    assert torch.equal(free_balls(torch.cat([near, far]), None, 1.75).center, near)
    config = tiny_config()
    assert VolSdfHost(config, FACTS, cameras=far).free_space is None
    assert VolSdfHost(config, FACTS, cameras=0.5 * near).free_space is None


def test_the_depth_is_that_of_the_deepest_ball():
    cameras = torch.cat([ring(9, 1.5), ring(5, 1.9) + torch.tensor([0.0, 0.0, 0.4])])
    balls = free_balls(cameras, None, 1.75)
    space = FreeSpace(balls, 1.75)
    x = 1.75 * (2 * torch.rand(3000, 3, generator=torch.Generator().manual_seed(0)) - 1)
    truth = (balls.radius - (x[:, None] - balls.center).norm(dim=-1)).amax(dim=-1)
    found = space(x)
    cell = 3.5 / 63
    assert (found.depth <= truth + 1e-6).all()
    assert (truth - found.depth).max() < 1.5 * 3**0.5 * cell
    assert (truth - found.depth).mean() < 0.05 * cell
    assert found.gradient.norm(dim=-1) == pytest.approx(torch.ones(3000))
    step = 1e-3
    ahead = space(x + step * found.gradient).depth
    assert (ahead - found.depth).median().item() == pytest.approx(step, rel=0.01)


def test_fog_in_front_of_a_camera_is_cut_out_and_the_object_is_not():
    config = tiny_config()
    cameras = ring(12, 1.5)
    torch.manual_seed(0)
    cut, whole = (VolSdfHost(config, FACTS, cameras=places).eval() for places in (cameras, None))
    cut.load_state_dict(whole.state_dict())
    with torch.no_grad():
        # First the object: both show the initial ball of the field.
        rays = RayBatch(cameras, torch.nn.functional.normalize(-cameras, dim=-1))
        seen, also = whole.render(rays), cut.render(rays)
        assert (seen.position - also.position).abs().max() < 0.02
        assert also.position.norm(dim=-1).max() < 0.9
        # Then a field that is solid everywhere, like fog in front of the camera.
        for host in (cut, whole):
            host.sdf_field.forward = lambda x: torch.full_like(x[:, 0], -0.2)
            exact = host.sdf_field.with_gradient
            host.sdf_field.with_gradient = lambda x, exact=exact: dataclasses.replace(
                exact(x), distance=torch.full_like(x[:, 0], -0.2)
            )
        assert (whole.render(rays).position - cameras).norm(dim=-1).max() < 0.1
        first = (cut.render(rays).position - cameras).norm(dim=-1)
        assert first.min() > 0.9 * 0.375, "a quarter of the distance is free"
        # Rays from the object to a camera also cross its ball: free space does not depend on the ray.
        assert (cut.sdf(0.8 * cameras) > 0).all()
        assert (whole.sdf(0.8 * cameras) < 0).all()
