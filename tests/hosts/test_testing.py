"""The contract suite: correct hosts pass, and each defect has its own message."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from neilfpp_method.errors import UserError
from neilfpp_method.hosts.function import CallableHost
from neilfpp_method.hosts.testing import CHECKS, check_host
from neilfpp_method.structures import RayBatch
from tests.hosts.balls import Ball, BallHost, ball_rays
from tests.hosts.test_mesh import SPHERE, mesh_host
from tests.scenes import sphere_model


def test_the_reference_host_keeps_the_contract():
    report = check_host(sphere_model().host, ball_rays())
    assert report.host == "VolSdfHost"
    assert report.hits > 100
    assert report.trains_geometry
    assert len(report.checks) == len(CHECKS) + 1


def test_a_mesh_keeps_the_contract_without_trained_geometry():
    report = check_host(mesh_host(SPHERE), ball_rays(spread=0.8))
    assert 0 < report.hits < report.rays
    assert not report.trains_geometry


def test_a_function_keeps_the_contract():
    ball = Ball()
    report = check_host(CallableHost(ball), ball_rays(), list(ball.parameters()))
    assert report.host == "Ball"
    assert report.hits == 200
    assert check_host(ball, ball_rays()) == report  # a function is taken as it is
    assert check_host(ball.forward, ball_rays()).hits == 200


def test_a_function_without_parameters_trains_no_geometry():
    ball = Ball()
    report = check_host(lambda origins, directions: ball(origins, directions), ball_rays(), [])
    assert not report.trains_geometry


class Rasteriser:
    def render_image(self, camera):
        raise NotImplementedError


@pytest.mark.parametrize(
    ("host", "message"), [(Rasteriser(), "Rasteriser draws whole images"), (3, "int is not a host")]
)
def test_what_cannot_be_checked_is_refused(host, message):
    with pytest.raises(UserError, match=message):
        check_host(host, ball_rays())


def sideways(rays: RayBatch) -> torch.Tensor:
    return 0.1 * torch.linalg.cross(rays.directions, rays.directions.roll(1, dims=-1))


def missed(outputs: dict) -> torch.Tensor:
    return outputs["opacity"][:, None] == 0.0


def recomputed(rays: RayBatch, outputs: dict) -> dict:
    """A host that computes its normal by autograd and does not detach it."""
    with torch.enable_grad():
        return {"normal": outputs["normal"] * torch.ones((), requires_grad=True)}


def shift_origins(rays: RayBatch, outputs: dict) -> dict:
    rays.origins.add_(0.1)
    return {}


BROKEN = [
    (lambda r, o: {"color": o["color"][:, :2]}, r"its color has the shape \(200, 2\); return \(200, 3\)"),
    (lambda r, o: {"opacity": None}, r"its opacity is a NoneType"),
    (lambda r, o: {"opacity": o["opacity"] > 0}, r"its opacity is a torch.bool"),
    (
        lambda r, o: {"normal": o["normal"].double()},
        r"its normal is torch.float64, the rays are torch.float32",
    ),
    (lambda r, o: {"concentration": 0.1 * o["concentration"]}, r"200 rays hit nothing"),
    (lambda r, o: {"opacity": 2.0 * o["opacity"]}, r"its opacity is outside of \[0, 1\]"),
    (
        lambda r, o: {"normal": 0.5 * o["normal"]},
        r"its normal is not a unit vector: that of a hit has the length 0.5",
    ),
    (lambda r, o: {"normal": o["normal"] / 0.0 * 0.0}, r"its normal is not finite for 200 of 200 rays"),
    (lambda r, o: {"normal": -o["normal"]}, r"100% of its normals point away from the viewer"),
    (lambda r, o: {"position": o["position"] + sideways(r)}, r"hits do not lie on their ray"),
    (lambda r, o: {"position": 2.0 * r.origins - o["position"]}, r"hits lie behind the origin"),
    (lambda r, o: {"color": o["color"] - 9.0}, r"its color is negative"),
    (lambda r, o: {"color": o["color"] / 0.0}, r"its color is not finite"),
    (
        lambda r, o: {"color": (o["color"] / o["color"].median()).clamp_max(1.0)},
        r"50% of its colors are exactly 1",
    ),
    (
        lambda r, o: {"position": torch.where(missed(o), torch.nan, o["position"])},
        r"its position is not finite for a ray that misses",
    ),
    (
        lambda r, o: {"concentration": torch.ones_like(o["opacity"])},
        r"rays that lead away from the scene hit something",
    ),
    (
        lambda r, o: {"color": o["color"] * (1.0 + np.random.default_rng().random())},
        r"renders differently after the same seed",
    ),
    (shift_origins, r"changes its input"),
    (lambda r, o: {"color": o["color"].detach()}, r"no gradient flows from its color to its parameters"),
    (lambda r, o: {n: o[n].detach() for n in ("position", "normal")}, r"no gradient flows from its hits"),
    (
        lambda r, o: {"color": (o["color"] - o["color"].detach()).sqrt()},
        r"a gradient of its parameters is not finite",
    ),
    (recomputed, r"its normal carries a gradient under torch.no_grad"),
]


@pytest.mark.parametrize(("spoil", "message"), BROKEN, ids=[message[:40] for _, message in BROKEN])
def test_a_defect_is_named(spoil, message):
    with pytest.raises(AssertionError, match=f"^BallHost: {message}"):
        check_host(BallHost(spoil), ball_rays())


def test_a_host_that_changes_gradients_is_reported():
    host = BallHost()

    def render_and_step(rays: RayBatch, outputs: dict) -> dict:
        host.radius.grad = torch.zeros(())
        return {}

    host.spoil = render_and_step
    with pytest.raises(AssertionError, match="rendering changes requires_grad or grad"):
        check_host(host, ball_rays())


def test_the_host_without_defects_keeps_the_contract():
    assert check_host(BallHost(), ball_rays()).hits == 200
