"""Smoothed normals compared with surfaces whose normals are known."""

from __future__ import annotations

import math

import torch
from torch.nn.functional import normalize

from neilfpp_method.hosts.smooth_normals import NEIGHBORS, smooth_normals
from neilfpp_method.settings.plain import changed
from tests.scenes import sphere_batch, sphere_model, tiny_config

RADIUS = 0.15


def degrees_between(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    return torch.rad2deg(torch.acos((a * b).sum(-1).clamp(-1, 1)))


def test_a_sphere_keeps_its_normals():
    torch.manual_seed(0)
    normal = normalize(torch.randn(100, 3, dtype=torch.float64), dim=-1)
    found = smooth_normals(lambda x: x, 0.3 * normal, normal, RADIUS)
    torch.testing.assert_close(found, normal, atol=1e-7, rtol=0)


def test_ripples_are_removed():
    """A floor with waves of the size of a grid cell, 0.03, and slopes of up to 5°."""
    waves, slope = 2 * math.pi / 0.03, math.tan(math.radians(5.0))

    def gradient(x: torch.Tensor) -> torch.Tensor:
        return torch.stack(
            (slope * (waves * x[:, 0]).sin(), slope * (waves * x[:, 1]).cos(), torch.ones(len(x))), -1
        )

    torch.manual_seed(0)
    position = torch.rand(500, 3) * torch.tensor([1.0, 1.0, 0.0])
    rough = normalize(gradient(position), dim=-1)
    up = torch.tensor([0.0, 0.0, 1.0])
    found = smooth_normals(gradient, position, rough, RADIUS)
    assert degrees_between(found, up).median() < degrees_between(rough, up).median() / 3


def test_edges_are_kept():
    def gradient(x: torch.Tensor) -> torch.Tensor:
        """Of the distance from the cube |x| < 0.5."""
        return torch.nn.functional.one_hot(x.abs().argmax(-1), 3) * x.sign()

    torch.manual_seed(0)
    inset = torch.rand(500, 2) * 0.96 - 0.48
    position = torch.cat((inset, torch.full((500, 1), 0.5)), -1)
    up = torch.tensor([0.0, 0.0, 1.0])
    found = smooth_normals(gradient, position, up.expand(500, 3), RADIUS)
    assert degrees_between(found, up).max() < 0.1


def test_points_without_a_normal_stay_finite():
    zero = torch.zeros(3, 3)
    assert smooth_normals(torch.zeros_like, zero, zero, RADIUS).isfinite().all()
    up = torch.tensor([[0.0, 0.0, 1.0]])
    torch.testing.assert_close(smooth_normals(torch.zeros_like, zero[:1], up, RADIUS), up)


def test_an_empty_batch_of_points():
    none = torch.zeros(0, 3)
    assert smooth_normals(lambda x: x, none, none, RADIUS).shape == (0, 3)


def test_normals_of_the_host_evaluate_no_neighbors():
    config = tiny_config()
    for normals, expected in (("host", 0), ("refined", NEIGHBORS)):
        model = sphere_model(changed(config, {"shading.normals": normals}))
        hits = model.host.render(sphere_batch(spread=0.3).rays).detach()
        asked = []
        original = model.host.sdf_field.with_gradient
        model.host.sdf_field.with_gradient = lambda x, original=original, asked=asked: (
            asked.append(len(x)) or original(x)
        )
        model.shading_normals(hits.position, hits.normal)
        assert sum(asked) == expected * len(hits)


def test_the_gradient_is_that_of_the_hit_normals():
    model = sphere_model()
    hits = model.host.render(sphere_batch(spread=0.3).rays).detach()
    normal = hits.normal.clone().requires_grad_()
    weight = torch.randn_like(normal)
    (gradient,) = torch.autograd.grad((model.shading_normals(hits.position, normal) * weight).sum(), normal)
    torch.testing.assert_close(gradient, weight)
