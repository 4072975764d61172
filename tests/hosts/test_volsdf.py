"""The reference host on a sphere whose picture is known."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from torch.nn.functional import normalize

from neilfpp_method.hosts.base import HasParameterGroups, HasSurfaceWidth, Host, Regularised
from neilfpp_method.hosts.volsdf import VolSdfHost
from neilfpp_method.structures import OrientedPoints, RayBatch
from tests.scenes import sphere_batch, sphere_model, tiny_config

RADIUS = 0.6


def thin_surface(background: str = "constant") -> VolSdfHost:
    """The sphere with a thin surface layer."""
    config = tiny_config()
    config = dataclasses.replace(
        config, volume=dataclasses.replace(config.volume, beta_init=2e-3, initial_samples=64, rounds=4, samples=64)
    )
    return sphere_model(config, background=background).eval().host


@pytest.fixture
def sharp() -> VolSdfHost:
    return thin_surface()


def test_it_keeps_the_contracts(sharp):
    assert isinstance(sharp, Host)
    assert isinstance(sharp, Regularised)
    assert isinstance(sharp, HasSurfaceWidth)
    assert isinstance(sharp, HasParameterGroups)


def test_hits_lie_on_the_zero_set_with_its_normals(sharp):
    hits = sharp.render(sphere_batch(spread=0.3).rays)
    assert hits.is_hit(0.8).all()
    assert hits.opacity.min() > 0.99
    assert sharp.sdf(hits.position).abs().max() < 0.01
    torch.testing.assert_close(hits.position.norm(dim=-1), torch.full((48,), RADIUS), atol=0.1, rtol=0.0)
    steps = 1e-2 * torch.eye(3)
    slope = torch.stack([sharp.sdf(hits.position + e) - sharp.sdf(hits.position - e) for e in steps], dim=-1)
    assert (hits.normal * normalize(slope, dim=-1)).sum(-1).min() > 0.98
    torch.testing.assert_close(hits.normal.norm(dim=-1), torch.ones(48))


def test_a_miss_is_no_hit_and_shows_the_background(sharp):
    sharp.background_color.fill_(0.25)
    misses = RayBatch(torch.tensor([[0.0, 0.0, -3.0], [0.0, 9.0, -3.0]]), torch.tensor([[0.0, 1.0, 0.0]] * 2))
    hits = sharp.render(misses)
    assert not hits.is_hit(0.8).any()
    torch.testing.assert_close(hits.color, torch.full((2, 3), 0.25), atol=1e-3, rtol=0.0)
    assert hits.position.isfinite().all()


def test_without_a_background_the_sphere_of_the_scene_closes_it():
    host = sphere_model(background="none").eval().host
    hits = host.render(sphere_batch(spread=4.0).rays)
    beyond = hits.position.norm(dim=-1) > 1.0
    assert beyond.any()
    assert not hits.is_hit(0.8)[beyond].any()  # painted by R, but no surface of the object
    x = torch.tensor([[1.7, 0.0, 0.0], [0.0, 0.0, 0.9]])
    torch.testing.assert_close(host.sdf(x), torch.tensor([1.75 - 1.7, 0.9 - RADIUS]), atol=0.1, rtol=0.0)


def test_only_the_named_losses_are_computed(sharp):
    batch = sphere_batch(8)
    assert set(sharp.render_regularised(batch, ["eikonal", "surface"]).terms) == {"eikonal", "surface"}
    assert sharp.render_regularised(batch, []).terms == {}


@pytest.mark.parametrize("background", ["constant", "none"])
def test_a_mask_removes_a_solid_that_stands_in_empty_space(background):
    """No ray comes through, so opacity has no slope; the surface must give way all the same, and not by getting foggy."""
    host = thin_surface(background)
    batch = sphere_batch(32, spread=0.2)
    inside = 0.5 * batch.origins  # of the sphere that closes a scene without background
    empty = dataclasses.replace(batch, origins=inside, mask=torch.zeros(32), mask_known=torch.ones(32))
    rendered = host.render_regularised(empty, ["mask"])
    assert rendered.hits.opacity.min() > 0.99
    rendered.terms["mask"].mean().backward()
    at, push = rendered.hits.position.detach(), torch.zeros(32)
    for parameter in host.sdf_field.parameters():
        before = parameter.detach().clone()
        with torch.no_grad():
            push -= host.sdf(at)
            parameter -= 1e-3 * parameter.grad
            push += host.sdf(at)
            parameter.copy_(before)
    assert push.min() > 1e-4
    assert host.density.above_floor.grad == 0.0


def test_a_cloud_on_the_surface_costs_little_and_one_off_it_its_distance():
    direction = normalize(torch.randn(64, 3), dim=-1)
    for radius, expected in ((RADIUS, 0.0), (RADIUS + 0.3, 0.3)):
        host = VolSdfHost(tiny_config(), 3.0, "constant", points=OrientedPoints(radius * direction, direction))
        term = host.render_regularised(sphere_batch(8), ["point_cloud"]).terms["point_cloud"]
        assert term.mean().item() == pytest.approx(expected, abs=0.15)  # the field starts as a rough sphere


def test_the_background_field_moves_only_where_it_is_the_background():
    assert "background" in sphere_model(background="inverted_sphere").host.parameter_groups()
    assert "background" not in sphere_model(background="constant").host.parameter_groups()
