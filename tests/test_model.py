"""The method on a host: the computations of a step, the savings of a switch, and the trained fields of each
stage.
"""

from __future__ import annotations

import dataclasses
import math
from collections import Counter

import pytest
import torch

from neilfpp_method import losses
from neilfpp_method import model as model_module
from neilfpp_method.hosts.base import TracesLight
from neilfpp_method.incident.scene import scene_light
from neilfpp_method.incident.traced import trace_light
from neilfpp_method.model import NeilfModel
from neilfpp_method.schedule import Stage, active_losses, weigh
from neilfpp_method.settings.facts import SceneFacts
from neilfpp_method.settings.plain import changed
from neilfpp_method.settings.types import MapLightConfig, MeshConfig, NeilfConfig
from neilfpp_method.structures import Material, RayBatch, SurfaceHits
from neilfpp_method.train.optimizer import make_optimizer
from tests.scenes import sphere_batch, sphere_model, tiny_config
from tests.train.small_runs import solved_light


def count_queries(model, run) -> Counter:
    """Numbers of points at which each field is evaluated, and of rays that the host renders, while `run`
    runs.
    """
    counts = Counter()
    handles = []
    for name, field in (("sdf", model.host.sdf_field), ("brdf", model.brdf)):
        for method in ("forward", "with_gradient", "with_gradients", "hessian"):
            if hasattr(field, method):
                handles.append((field, method, getattr(field, method)))
                setattr(field, method, _counted(getattr(field, method), counts, name))
    handles += [(model.light, "radiance", model.light.radiance), (model.host, "_march", model.host._march)]
    model.light.radiance = _counted(model.light.radiance, counts, "light")
    model.host._march = _counted(model.host._march, counts, "rays")
    run()
    for owner, method, original in handles:
        setattr(owner, method, original)
    return counts


def _counted(function, counts, name):
    def call(first, *rest, **options):
        counts[name] += len(rest[0].flatten(0, -2)) if name == "light" else len(first)
        return function(first, *rest, **options)

    return call


def test_an_effect_that_is_off_makes_no_queries():
    base = tiny_config()
    # With β = 0.02 a quarter of a ray's weight lies further than 0.05 from its hit.
    base = dataclasses.replace(base, shading=dataclasses.replace(base.shading, hit_share=0.5))
    off = dataclasses.replace(base.light, inter_reflection="off")
    batch = sphere_batch()

    def queries(config):
        model = sphere_model(config)
        return count_queries(model, lambda: model.losses(batch, Stage.MATERIAL_INIT))

    on, without = queries(base), queries(dataclasses.replace(base, light=off))
    assert without["rays"] == len(batch)  # the camera's rays and no others
    assert on["rays"] > without["rays"]
    assert without["light"] % base.shading.train_samples == 0

    model = sphere_model(base)
    first_stage = count_queries(model, lambda: model.losses(batch, Stage.SDF_INIT))
    assert first_stage["brdf"] == first_stage["light"] == 0

    plain = sphere_model(changed(base, {"host.loss.hessian": (0.0, 0.0, 0.0)}))
    fewer = count_queries(plain, lambda: plain.losses(batch, Stage.SDF_INIT))
    assert fewer["sdf"] < first_stage["sdf"]


def test_an_image_of_r_evaluates_no_material():
    model = sphere_model().eval()
    counts = count_queries(model, lambda: model.host_maps(sphere_batch().rays))
    assert counts["brdf"] == counts["light"] == 0


@pytest.mark.parametrize("stage", Stage)
def test_a_stage_trains_exactly_the_fields_of_the_table(stage):
    moves = {
        Stage.SDF_INIT: {"geometry", "beta", "radiance"},
        Stage.MATERIAL_INIT: {"brdf", "light"},
        Stage.JOINT: {"geometry", "beta", "radiance", "brdf", "light"},
    }[stage]
    config = tiny_config()
    model = sphere_model(config)
    optimizer = make_optimizer(model, config.optimizer)
    # Momentum from an earlier stage must not change fields that this stage does not train.
    weigh(model.losses(sphere_batch(), Stage.JOINT), active_losses(Stage.JOINT, config)).loss.backward()
    optimizer.step()
    before = {name: [p.detach().clone() for p in group] for name, group in model.parameter_groups().items()}
    model.freeze_for(stage)
    for _ in range(2):
        optimizer.zero_grad()
        weigh(model.losses(sphere_batch(), stage), active_losses(stage, config)).loss.backward()
        optimizer.step()
    for name, group in model.parameter_groups().items():
        moved = any(not torch.equal(old, new) for old, new in zip(before[name], group, strict=True))
        assert moved == (name in moves), name


def test_the_first_render_matches_the_median_of_the_images():
    config = tiny_config()
    config = dataclasses.replace(config, shading=dataclasses.replace(config.shading, eval_samples=256))
    model = sphere_model(config).eval()
    maps = model.maps(sphere_batch(spread=0.1).rays)
    assert maps.rgb.mean().item() == pytest.approx(model.facts.median_radiance, rel=0.15)


def test_pbr_color_of_a_white_furnace():
    """Under light of 1 from all directions the colour of a Lambertian surface is its base colour, with any
    host.
    """
    config = tiny_config()
    config = dataclasses.replace(config, shading=dataclasses.replace(config.shading, specular=False))
    model = sphere_model(config).eval()
    model.light.radiance = lambda x, wi: torch.ones_like(wi)
    maps = model.maps(sphere_batch(spread=0.3).rays)
    torch.testing.assert_close(maps.rgb, maps.base_color, atol=1e-4, rtol=0.0)


@pytest.mark.parametrize(("opacity", "material", "shaded"), [(0.9, 1, 1), (0.3, 1, 0), (0.005, 0, 0)])
def test_a_pixel_that_a_silhouette_partly_covers_has_the_material(opacity, material, shaded):
    """Its colour is that of the host, which mixes the object with what lies behind."""
    model = sphere_model().eval()
    rays = sphere_batch(spread=0.3).rays
    hits = model.host.render(rays).detach()
    maps = model.maps(rays, dataclasses.replace(hits, opacity=torch.full_like(hits.opacity, opacity)))
    assert bool(maps.base_color.any()) == bool(material)
    assert torch.equal(maps.rgb, maps.rgb_volume) == (not shaded)
    assert bool(maps.specular.any()) == bool(shaded)


class Room:
    """A host: a closed room whose walls, 2 scene units from the origin, have their own normal as radiance."""

    def render(self, rays: RayBatch) -> SurfaceHits:
        along = (rays.origins * rays.directions).sum(-1)
        depth = (along**2 + 4.0 - rays.origins.square().sum(-1)).sqrt() - along
        position = rays.origins + depth[:, None] * rays.directions
        ones = torch.ones(len(rays))
        return SurfaceHits(position / 2.0, position, -position / 2.0, ones, ones)


def with_rays_per_point(count: float) -> NeilfConfig:
    settings = tiny_config()
    light = dataclasses.replace(settings.light, rays_per_point=count)
    return dataclasses.replace(settings, light=light)


def test_traced_light_is_the_radiance_of_the_wall():
    torch.manual_seed(0)
    position, normal = torch.zeros(500, 3), torch.tensor([[0.0, 0.0, 1.0]]).expand(500, 3)
    traced = trace_light(Room(), position, normal, with_rays_per_point(2.5))
    assert len(traced.wi) == 1250  # each point twice, and half of them once more
    torch.testing.assert_close(traced.radiance, traced.wi, atol=1e-3, rtol=0.0)
    cosine = traced.wi[:, 2]
    least = torch.cos(torch.deg2rad(torch.tensor(80.0)))
    assert cosine.min() >= least
    # Uniform in solid angle: the cosine is uniform on [cos 80°, 1].
    assert cosine.mean().item() == pytest.approx((1.0 + least.item()) / 2.0, abs=0.02)


class Recorder(Room):
    """The room with a surface layer of a given width; records the rays that it renders."""

    def __init__(self, width: float) -> None:
        self.width = torch.tensor(width)

    def surface_width(self):
        return self.width

    def render(self, rays):
        self.rays = rays
        return super().render(rays)


def test_a_ray_starts_further_out_at_grazing_angles_and_for_thicker_layers():
    host, settings = Recorder(0.003), with_rays_per_point(1.0)
    normal = torch.tensor([[0.0, 0.0, 1.0]]).expand(200, 3)
    trace_light(host, torch.zeros(200, 3), normal, settings)
    torch.testing.assert_close(host.rays.origins[:, 2], torch.full((200,), settings.ray_offset + 4 * 0.003))
    assert host.rays.origins.norm(dim=-1).max() > 2.0 * host.rays.origins.norm(dim=-1).min()


def test_no_ray_starts_further_out_than_the_published_bound():
    """β = 0.03 requires a height of 0.14, which is 0.73 along the ray at 79°. From 46° on, the bound of 0.2
    would start a ray within the layer.
    """
    torch.manual_seed(0)
    host, settings = Recorder(0.03), with_rays_per_point(1.0)
    normal = torch.tensor([[0.0, 0.0, 1.0]]).expand(500, 3)
    traced = trace_light(host, torch.zeros(500, 3), normal, settings)
    assert host.rays.origins.norm(dim=-1).max() <= 0.2
    steepest = (settings.ray_offset + 4 * 0.03) / 0.2
    assert traced.wi[:, 2].min().item() == pytest.approx(steepest, abs=0.02)
    assert len(traced.wi) == pytest.approx(500 * (1 - steepest) / (1 - math.cos(math.radians(80))), rel=0.15)


def test_a_light_without_color_is_compared_by_luminance():
    """Red, green and blue radiance of equal luminance agree with a grey light of that luminance."""
    config = tiny_config()
    model = sphere_model(
        dataclasses.replace(config, light=dataclasses.replace(config.light, monochrome=True))
    )
    gray, colors = torch.full((3, 3), 0.05), torch.diag(0.05 / torch.tensor([0.2126, 0.7152, 0.0722]))
    assert losses.inter_reflection(gray, colors, monochrome=True).mean() < 1e-6
    assert losses.inter_reflection(gray, colors).mean() > 0.05
    model.light.radiance = lambda x, wi: torch.full((*wi.shape[:2], 3), 0.05)
    model.host.render = lambda rays: SurfaceHits(
        colors[:1].expand(len(rays), 3), rays.origins, rays.directions, *torch.ones(2, len(rays))
    )
    at = torch.tensor([[0.0, 0.0, 0.6]]).expand(8, 3)
    assert model._inter_reflection(at, at / 0.6).mean() < 1e-6


def test_the_gradient_into_outgoing_radiance_is_scaled(monkeypatch):
    """R of recovered geometry gets none, and R of a mesh a share of it."""
    batch = sphere_batch()
    config = tiny_config()
    # Every ray counts as a hit.
    config = dataclasses.replace(config, shading=dataclasses.replace(config.shading, hit_share=0.0))
    gradients = {}
    for host, scale in ((config.host, 0.0), (MeshConfig(), 0.35), (MeshConfig(), 0.7)):
        monkeypatch.setattr("neilfpp_method.incident.traced.RADIANCE_GRADIENT", scale)
        model = sphere_model(config)
        model.use(dataclasses.replace(config, host=host))
        torch.manual_seed(3)
        hits = model.host.render(batch.rays).detach()
        term = model._inter_reflection(hits.position, hits.normal)
        weight = model.host.radiance_field.mlp.layers[-1].weight
        (gradient,) = torch.autograd.grad(term.mean(), weight, allow_unused=True)
        gradients[scale] = gradient
    assert gradients[0.0] is None
    torch.testing.assert_close(2.0 * gradients[0.35], gradients[0.7])


def test_material_gradients_reach_the_geometry_by_their_scales():
    batch = sphere_batch()
    config = tiny_config()

    def geometry_moves(position: float, normal: float) -> bool:
        loss = dataclasses.replace(config.loss, position_gradient=position, normal_gradient=normal)
        model = sphere_model(dataclasses.replace(config, loss=loss))
        term = model.losses(batch, Stage.JOINT)["physical"]
        gradients = torch.autograd.grad(
            term.mean(), list(model.host.sdf_field.parameters()), allow_unused=True
        )
        return any(g is not None and bool(g.abs().max() > 0.0) for g in gradients)

    assert not geometry_moves(0.0, 0.0)
    assert geometry_moves(0.1, 0.0)
    assert geometry_moves(0.0, 0.1)


@pytest.mark.parametrize("is_free", [True, False])
def test_l_phys_has_two_independent_estimates_under_a_solved_light(monkeypatch, is_free):
    """A light field that is learned has one, as published."""
    config = tiny_config() if is_free else solved_light(tiny_config())
    estimates, counts, compare, sample = [], [], losses.physical, model_module.sample_directions
    monkeypatch.setattr(losses, "physical", lambda *args: (estimates.append(args[:2]), compare(*args))[1])
    monkeypatch.setattr(
        model_module, "sample_directions", lambda s, *args: (counts.append(s.count), sample(s, *args))[1]
    )
    sphere_model(config).losses(sphere_batch(spread=0.3), Stage.MATERIAL_INIT)
    ((one, other),) = estimates
    assert len(one) > 40
    assert (one != other).any(-1).all() != is_free
    assert sum(counts) == config.shading.train_samples
    assert len(counts) == (1 if is_free else 2)


def test_a_batch_without_a_hit_trains_the_remaining_fields():
    model = sphere_model()
    batch = sphere_batch(spread=0.3)
    away = dataclasses.replace(batch, directions=-batch.directions)
    for stage in Stage:
        terms = model.losses(away, stage)
        loss = weigh(terms, active_losses(stage, model.config)).loss
        loss.backward()
        assert loss.isfinite()
        assert all(p.grad is None or p.grad.isfinite().all() for p in model.parameters())


def test_shading_has_two_parts():
    model = sphere_model().eval()
    maps = model.maps(sphere_batch(spread=0.3).rays)
    torch.testing.assert_close(maps.rgb, maps.diffuse + maps.specular)
    assert (maps.specular > 0).any()


class HalfRoom(Room):
    """The room, in which rays hit the wall only where z < 0."""

    def render(self, rays: RayBatch) -> SurfaceHits:
        hits = super().render(rays)
        met = (rays.directions[:, 2] < 0).float()
        return dataclasses.replace(hits, opacity=met, concentration=met)


def test_hard_inter_reflection_uses_the_scene_for_hits_and_the_light_otherwise():
    config = tiny_config(light=MapLightConfig(kind="distant"))
    model = NeilfModel(HalfRoom(), config, SceneFacts("linear", 0.2, 3.0, "constant"))
    wi = torch.nn.functional.normalize(torch.randn(1, 64, 3), dim=-1)
    arriving = model.incident_light(torch.zeros(1, 3), wi)[0]
    below = wi[0, :, 2] < 0
    torch.testing.assert_close(arriving[below], wi[0][below], atol=1e-3, rtol=0.0)
    sky = model.light.radiance(torch.zeros(1, 3), wi)[0]
    torch.testing.assert_close(arriving[~below], sky[~below])


def test_the_distance_of_rendered_light_is_measured_from_the_point():
    wi = torch.nn.functional.normalize(torch.randn(1, 64, 3), dim=-1)
    light = scene_light(Room(), torch.zeros(1, 3), wi, offset=0.1, hit_share=0.5)
    torch.testing.assert_close(light.distance, torch.full((1, 64), 2.0))


def test_an_sdf_host_traces_its_grid():
    """From a point on a sphere no direction hits it again; from between two plates every steep direction hits
    one.
    """
    config = tiny_config()
    hard = dataclasses.replace(config.light, inter_reflection="hard")
    config = dataclasses.replace(config, light=hard)
    host = sphere_model(config).host
    assert isinstance(host, TracesLight)
    out = torch.tensor([[0.0, 0.0, 1.0]])
    on_sphere = host.render(RayBatch(3.0 * out, -out)).position.detach()
    up = torch.nn.functional.normalize(
        torch.tensor([[[0.0, 0.0, 1.0], [0.5, 0.0, 1.0], [0.0, -1.0, 1.0]]]), dim=-1
    )
    assert not host.scene_light(on_sphere, up).hit.any()
    towards = host.scene_light(3.0 * out / 2, -up)
    assert towards.hit[0, 0]
    hits = host.render(RayBatch(3.0 * out / 2, -out))
    # The ray starts a cell of the grid (0.037) above the point, but its distance is measured from the point.
    met = 3.0 * out / 2 - towards.distance[0, :1, None] * out
    assert host.sdf_field.with_gradient(met).distance.abs().item() < 0.01
    # The radiance is that of R at the hit.
    torch.testing.assert_close(towards.radiance[0, 0], hits.color[0], atol=0.05, rtol=0.0)
    assert not towards.radiance.requires_grad


def test_the_tracing_grid_is_sampled_again_and_is_in_checkpoints():
    config = tiny_config()
    hard = dataclasses.replace(config.light, inter_reflection="hard")
    model = sphere_model(dataclasses.replace(config, light=hard))
    model.losses(sphere_batch(), Stage.MATERIAL_INIT)
    assert model.host.grid_age == 0
    model.losses(sphere_batch(), Stage.JOINT)
    assert model.host.grid_age == 1
    again = sphere_model(dataclasses.replace(config, light=hard))
    again.load_state_dict(model.state_dict())
    assert again.host.grid_age == 1
    assert torch.equal(again.host.distance_grid, model.host.distance_grid)


@pytest.mark.parametrize("kind", ["free", "distant", "auto"])
@pytest.mark.parametrize("sampler", ["fibonacci", "mis"])
def test_every_light_works_with_every_sampler(kind, sampler):
    """Under light of equal radiance from all directions, all samplers give the same result."""
    config = tiny_config()
    light = config.light if kind == "free" else MapLightConfig(kind=kind, environment_height=8)
    config = dataclasses.replace(
        config,
        light=dataclasses.replace(light, inter_reflection="off"),
        shading=dataclasses.replace(config.shading, sampler=sampler),
    )
    model = sphere_model(config).eval()
    position = torch.tensor([[0.0, 0.0, 0.6], [0.6, 0.0, 0.0]])
    normal = position / 0.6
    half = torch.full((2, 1), 0.5)
    metallic = torch.full((2, 1), config.brdf.initial_metallic)
    material = Material(torch.full((2, 3), config.brdf.initial_base_color), half, metallic)
    shading = model.shade(position, normal, normal, material, 512)
    torch.testing.assert_close(
        shading.color, torch.full((2, 3), model.facts.median_radiance), rtol=0.1, atol=0.0
    )


def test_a_lamp_lights_only_unoccluded_points():
    config = tiny_config(light=MapLightConfig(kind="auto", environment_height=8))
    model = NeilfModel(HalfRoom(), config, SceneFacts("linear", 0.2, 3.0, "constant")).eval()
    x, up = torch.zeros(2, 3), torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    half = torch.full((2, 1), 0.5)
    material = Material(half.expand(2, 3), half, half)
    before = model.shade(x, up, up, material, 64)
    # One lamp above, which is not occluded, and one below, behind the wall at 2.
    model.lamps.place(torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -2.5]]), torch.ones(2, 3))
    after = model.shade(x, up, up, material, 64)
    gained = (after.diffuse - before.diffuse)[:, 0]
    # A lamp at distance 1 in the direction of the normal: (1 − m) b/π · I/d².
    assert gained[0].item() == pytest.approx(0.25 / math.pi, rel=0.02)
    assert gained[1].item() == pytest.approx(0.0, abs=1e-6)
    seen = model.incident_light(x[:1], torch.tensor([[[0.0, 0.0, 1.0]]]))[0, 0]
    assert (seen > model.lamps.radiance()[0]).all()
