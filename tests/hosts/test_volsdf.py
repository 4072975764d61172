"""The reference host on a sphere whose image is known."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from neilfpp_method.fields.sdf import SdfSample
from neilfpp_method.hosts.base import HasParameterGroups, HasSurfaceWidth, Host, Regularized
from neilfpp_method.hosts.volsdf import VolSdfHost
from neilfpp_method.settings.check import MIN_SAMPLES
from neilfpp_method.settings.facts import SceneFacts
from neilfpp_method.settings.plain import changed, to_dict
from neilfpp_method.settings.presets import preset
from neilfpp_method.structures import OrientedPoints, RayBatch
from neilfpp_method.volume.density import laplace_density
from tests.scenes import sphere_batch, sphere_model, tiny_config

FACTS = SceneFacts("linear", 0.2, 3.0, "constant")
RADIUS = 0.6


def thin_surface(background: str = "constant") -> VolSdfHost:
    """The sphere with a thin surface layer."""
    config = changed(tiny_config(), {"host.volume": {"beta_init": 2e-3, "samples": 64}})
    return sphere_model(config, background=background).eval().host


@pytest.fixture
def sharp() -> VolSdfHost:
    return thin_surface()


def test_the_host_keeps_the_contracts(sharp):
    assert isinstance(sharp, Host)
    assert isinstance(sharp, Regularized)
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


def test_hits_lie_much_closer_to_the_zero_set_than_the_layer_is_wide():
    beta, density = 4e-3, "entering"
    config = changed(tiny_config(), {"host.volume": {"beta_init": beta, "samples": 64, "density": density}})
    host, rays = sphere_model(config).eval().host, sphere_batch(2000).rays
    hits = host.render(rays)
    off = host.sdf(hits.position[hits.is_hit(0.8)]).abs()
    assert len(off) > 500
    assert off.quantile(0.9) < 0.15 * beta  # the mean depth of such rays is 0.4 β inside


def test_hits_of_the_isotropic_density_are_the_mean_of_the_samples():
    """0.34 β inside where a ray meets the surface head-on: there both densities have the same weights."""
    beta = 4e-3
    config = changed(tiny_config(), {"host.volume": {"beta_init": beta, "samples": 64}})
    host = sphere_model(config).eval().host
    directions = normalize(torch.randn(500, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    hits = host.render(RayBatch(-2.5 * directions, directions))
    assert host.sdf(hits.position).median().item() == pytest.approx(-0.34 * beta, abs=0.05 * beta)


class BallBeforeWall(torch.nn.Module):
    """A ball around the origin, half a unit in front of the wall z = 1.1."""

    def forward(self, x: Tensor) -> Tensor:
        return torch.minimum(x.norm(dim=-1) - RADIUS, 1.1 - x[:, 2])

    def with_gradient(self, x: Tensor) -> SdfSample:
        is_ball = x.norm(dim=-1) - RADIUS < 1.1 - x[:, 2]
        gradient = torch.where(is_ball[:, None], normalize(x, dim=-1), torch.tensor([0.0, 0.0, -1.0]))
        return SdfSample(self(x), gradient, torch.zeros(len(x), 15))


def rays_past_the_ball(count: int = 400) -> RayBatch:
    """Parallel rays within 0.05 of the silhouette of the ball."""
    height = torch.linspace(RADIUS - 0.05, RADIUS + 0.05, count)
    origins = torch.stack((torch.zeros(count), height, torch.full((count,), -2.0)), -1)
    return RayBatch(origins, torch.tensor([[0.0, 0.0, 1.0]]).expand(count, 3))


def test_a_ray_past_an_edge_hits_one_of_its_two_surfaces():
    volume = {"beta_init": 0.003, "samples": 64, "density": "entering"}
    config = changed(tiny_config(), {"host.volume": volume})
    host = sphere_model(config).eval().host
    host.sdf_field = BallBeforeWall()
    with torch.no_grad():
        march = host._march(rays_past_the_ball(), colored=False)
    hits, depth = march.hits, march.hits.position[:, 2]
    on_ball, on_wall = depth < 0.1, (depth - 1.1).abs() < 0.03
    assert (on_ball | on_wall).float().mean() > 0.97
    assert on_ball.sum() > 100
    assert on_wall.sum() > 100
    assert (hits.normal[on_wall, 2] < -0.98).float().mean() > 0.97
    # Many of these rays meet both: their mean depth would lie between the two.
    assert ((hits.concentration > 0.1) & (hits.concentration < 0.9)).sum() > 20


def test_a_miss_has_the_background_color(sharp):
    sharp.background_color.fill_(0.25)
    misses = RayBatch(torch.tensor([[0.0, 0.0, -3.0], [0.0, 9.0, -3.0]]), torch.tensor([[0.0, 1.0, 0.0]] * 2))
    hits = sharp.render(misses)
    assert not hits.is_hit(0.8).any()
    torch.testing.assert_close(hits.color, torch.full((2, 3), 0.25), atol=1e-3, rtol=0.0)
    assert hits.position.isfinite().all()


@pytest.mark.parametrize("skip_empty", [False, True])
def test_without_a_background_the_scene_sphere_has_the_radiance_of_r(skip_empty):
    config = changed(tiny_config(), {"host.volume.skip_empty": skip_empty})
    host = sphere_model(config, background="none").train().host
    host.radiance_field.forward = lambda x, wo, normal, feature: x.norm(dim=-1, keepdim=True).expand(
        -1, 3
    )  # how far out
    rays = RayBatch(torch.tensor([[0.0, 1.2, -1.0], [0.0, 0.0, -3.0]]), torch.tensor([[0.0, 0.0, 1.0]] * 2))
    past, onto = host.render(rays).color[:, 0]
    assert past.item() == pytest.approx(config.background.radius, abs=1e-3)
    assert onto.item() == pytest.approx(RADIUS, abs=0.1)
    assert host.render(rays).opacity[0] < 1e-3  # painted by R, but no surface of the object


# ------------------------------------------------------------------------------------------------ silhouettes


def true_opacity(gap: Tensor, beta: float, density: str) -> Tensor:
    """Opacity of rays that pass the centre of the sphere at a distance `gap`: the density summed over 40,000
    steps, float64. The entering density acts where the distance falls, by its slope.
    """
    along = torch.linspace(-1.7, 1.7, 40_001, dtype=torch.float64)
    distance = (gap.double()[:, None].square() + along.square()).sqrt() - RADIUS
    extinction = laplace_density(distance, torch.tensor(beta, dtype=torch.float64))
    if density == "entering":
        extinction = extinction * (-along / (distance + RADIUS)).clamp_min(0.0)
    return -torch.expm1(-extinction.sum(-1) * (along[1] - along[0]))


@pytest.mark.parametrize(
    ("name", "beta", "error"),
    [("fast", 0.003, 0.02), ("fast", 0.03, 0.004), ("paper-mlp", 0.003, 0.002), ("paper-mlp", 0.03, 0.002)],
)
@pytest.mark.parametrize("training", [True, False])
def test_the_opacity_of_rays_that_graze_a_sphere_is_accurate(name, beta, error, training):
    """The rendered opacity, not the sampler's bound: for rays that a thin layer covers in part, with an exact
    sphere.
    """
    named = preset(name)
    volume = {**to_dict(named.host.volume), "beta_init": beta}
    config = changed(tiny_config(), {"host.volume": volume, "background.radius": named.background.radius})
    host = sphere_model(config).train(training).host
    exact = lambda x: x.norm(dim=-1) - RADIUS  # noqa: E731
    host.sdf_field.forward = exact
    host.sdf_field.with_gradient = lambda x: SdfSample(exact(x), normalize(x, dim=-1), torch.zeros(len(x), 4))
    gap = RADIUS + beta * torch.linspace(-2.0, 7.0, 64)
    origins = torch.stack([gap, torch.zeros(64), torch.full((64,), -2.5)], dim=-1)
    hits = host.render(RayBatch(origins, torch.tensor([[0.0, 0.0, 1.0]]).expand(64, 3)))
    expected = true_opacity(gap, beta, config.host.volume.density)
    partly = (expected > 0.05) & (expected < 0.95)
    assert partly.sum() > 20
    off = hits.opacity[partly] - expected[partly]
    assert off.square().mean().sqrt() < error
    depth = hits.position[partly, 2]
    assert (
        depth.abs().max() < 3.0 * (2.0 * RADIUS * beta) ** 0.5
    )  # as far as the layer reaches along such a ray


def test_the_automatic_density_acts_at_entry_if_geometry_starts_as_a_shape():
    """From a ball, the isotropic density finds bowls and thin shapes that the entering one misses."""
    host = sphere_model(changed(tiny_config(), {"host.volume.density": "auto"})).host
    assert host.density_kind == "isotropic"
    host.limit_surface_width(0.01)
    assert host.surface_width().item() == pytest.approx(0.005)
    host.starts_from_shape = True
    assert host.density_kind == "entering"
    host.limit_surface_width(4e-3)
    assert host.surface_width().item() == pytest.approx(4e-3)
    resumed = sphere_model(changed(tiny_config(), {"host.volume.density": "auto"})).host
    resumed.load_state_dict(host.state_dict())
    assert resumed.density_kind == "entering"
    for kind in ("isotropic", "entering"):
        named = sphere_model(changed(tiny_config(), {"host.volume.density": kind})).host
        named.starts_from_shape = True
        assert named.density_kind == kind


@pytest.mark.parametrize("density", ["isotropic", "entering"])
def test_the_smallest_number_of_samples_renders(density):
    config = changed(tiny_config(), {"host.volume.samples": MIN_SAMPLES, "host.volume.density": density})
    host = sphere_model(config).host
    hits = host.render_regularized(sphere_batch(8), ["volume", "mask"]).hits
    assert hits.color.isfinite().all()
    assert hits.position.isfinite().all()


def test_only_the_named_losses_are_computed(sharp):
    batch = sphere_batch(8)
    assert set(sharp.render_regularized(batch, ["eikonal", "surface"]).terms) == {"eikonal", "surface"}
    assert sharp.render_regularized(batch, []).terms == {}


def test_r_is_not_evaluated_without_l_vol(monkeypatch):
    host, batch = sphere_model().host, sphere_batch()
    torch.manual_seed(0)
    whole = host.render_regularized(batch, ["volume"]).hits
    monkeypatch.setattr(host, "radiance_field", None)
    torch.manual_seed(0)
    hits = host.render_regularized(batch, ["eikonal"]).hits
    assert not hits.color.any()
    for name in ("position", "normal", "opacity", "concentration"):
        torch.testing.assert_close(getattr(hits, name), getattr(whole, name))


def test_regularizers_cover_the_whole_scene():
    """For G = c · x the losses are known at every point, so their means and counts show which points are
    used.
    """
    config = changed(tiny_config(), {"host.loss.points": "scene"})
    host, batch, asked = sphere_model(config).train().host, sphere_batch(16), []
    slope = torch.tensor([0.0, 0.0, 2.0])
    host.sdf_field.with_gradient = lambda x: (
        asked.append(x) or SdfSample(x @ slope, slope.expand_as(x), torch.zeros(len(x), 4))
    )
    host.sdf_field.hessian = lambda x: asked.append(x) or torch.zeros(len(x), 3, 3)
    terms = host.render_regularized(batch, ["eikonal", "surface", "hessian"]).terms
    _, points, curved = asked
    assert points is curved
    assert points.shape == (3 * 16, 3)  # 8192 about the object and 4096 in the scene for 4096 rays
    assert points[:32].abs().max() <= 1.0
    assert 1.0 < points[32:].abs().max() <= config.background.radius
    assert terms["eikonal"].values.shape == (4 * 16,)  # one sample of each ray as well
    assert terms["eikonal"].mean().item() == pytest.approx(1.0)
    torch.testing.assert_close(terms["surface"].values, 10.0 / (torch.pi * (100.0 + (points @ slope) ** 2)))


@pytest.mark.parametrize("background", ["constant", "none"])
def test_a_mask_removes_a_solid_in_empty_space(background):
    """Behind the solid the opacity has no gradient; the surface must still move, and β must not grow."""
    host = thin_surface(background)
    batch = sphere_batch(32, spread=0.2)
    inside = 0.5 * batch.origins  # of the sphere that closes a scene without background
    empty = dataclasses.replace(batch, origins=inside, mask=torch.zeros(32), mask_known=torch.ones(32))
    rendered = host.render_regularized(empty, ["mask"])
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
    assert host.density.above_floor.grad is None


def test_a_mask_brings_the_surface_back_to_rays_that_miss_it():
    """Their opacity is 0 in single precision; a step along the gradient must bring the surface closer."""
    host = thin_surface()
    batch = sphere_batch(32, spread=0.0)
    beside = torch.linspace(0.0, 1.5, 1500)[:, None] * torch.tensor([1.0, 0.0, 0.0])
    nearest = beside[(host.sdf(beside) > 0.03).nonzero()[0, 0]]
    missing = dataclasses.replace(batch, origins=batch.origins + nearest, mask_known=torch.ones(32))
    rendered = host.render_regularized(missing, ["mask"])
    assert rendered.hits.opacity.max() < 1e-4
    rendered.terms["mask"].mean().backward()
    with torch.no_grad():
        before = host.sdf(nearest[None])
        for parameter in host.sdf_field.parameters():
            parameter -= 1e-4 * parameter.grad
        assert host.sdf(nearest[None]) < before - 1e-4
    assert host.density.above_floor.grad is None


def test_the_loss_of_a_point_cloud_is_its_distance():
    direction = normalize(torch.randn(64, 3), dim=-1)
    for radius, expected in ((RADIUS, 0.0), (RADIUS + 0.3, 0.3)):
        host = VolSdfHost(tiny_config(), FACTS, points=OrientedPoints(radius * direction, direction))
        term = host.render_regularized(sphere_batch(8), ["point_cloud"]).terms["point_cloud"]
        assert term.mean().item() == pytest.approx(expected, abs=0.15)  # the field starts as a rough sphere


def test_the_background_field_gets_gradients_only_from_rays_that_show_it():
    assert "background" in sphere_model(background="inverted_sphere").host.parameter_groups()
    assert "background" not in sphere_model(background="constant").host.parameter_groups()
