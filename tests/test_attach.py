"""The method attached to a host and a training loop outside of the package."""

from __future__ import annotations

import dataclasses
import logging
import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch
from torch import nn

from neilfpp_method.attach import attach_neilf, pixel_batch
from neilfpp_method.data.files.images import write_exr
from neilfpp_method.errors import UserError
from neilfpp_method.hosts.capabilities import missing_capabilities
from neilfpp_method.hosts.function import CallableHost
from neilfpp_method.hosts.volsdf import VolSdfHost
from neilfpp_method.schedule import Stage, active_losses, weigh
from neilfpp_method.settings.facts import SceneFacts
from neilfpp_method.settings.types import MapLightConfig
from neilfpp_method.structures import PixelBatch
from tests.hosts.balls import Ball, BallHost, ball_rays
from tests.hosts.test_mesh import SPHERE, mesh_config, mesh_host
from tests.scenes import sphere_batch, sphere_model, tiny_config
from tests.train.small_runs import solved_light


def pixels(seed: int = 0, spread: float = 0.3) -> PixelBatch:
    rays = ball_rays(64, spread, seed)
    return pixel_batch(rays.origins, rays.directions, torch.tensor([[0.4, 0.2, 0.1]]).expand(64, 3))


def steps(sdf: int, material: int, joint: int):
    config = tiny_config()
    return dataclasses.replace(
        config,
        train=dataclasses.replace(config.train, sdf_steps=sdf, material_steps=material, joint_steps=joint),
        loss=dataclasses.replace(config.loss, normal_gradient=1.0, position_gradient=0.1),
    )


def state(module: nn.Module) -> list[torch.Tensor]:
    return [p.detach().clone() for p in module.parameters()]


def same(one: list[torch.Tensor], other: list[torch.Tensor]) -> bool:
    return all(torch.equal(a, b) for a, b in zip(one, other, strict=True))


# --------------------------------------------------------------------------------------- somebody else's loop


def test_three_lines_in_a_foreign_loop():
    torch.manual_seed(0)
    host = Ball()
    optimizer = torch.optim.Adam(host.parameters(), lr=1e-2)
    neilf = attach_neilf(host, steps(sdf=5, material=60, joint=10))
    optimizer.add_param_group({"params": neilf.parameters(), "lr": 3e-3})
    requires = [p.requires_grad for p in host.parameters()]
    before = {}
    physical = []
    for step in range(75):
        if step in (0, 5, 65):
            before[step] = state(host), state(neilf)
        total = neilf.losses(pixels(step), step)
        optimizer.zero_grad()
        total.loss.backward()
        optimizer.step()
        physical += [total.terms["physical"].item()] if "physical" in total.terms else []
        assert [p.requires_grad for p in host.parameters()] == requires
    assert len(physical) == 70
    assert sum(physical[-10:]) < 0.5 * sum(physical[:10])
    # The host waits for the joint stage, bit for bit; the material for its own.
    assert same(before[0][0], before[65][0])
    assert not same(before[65][0], state(host))
    assert same(before[0][1], before[5][1])
    assert not same(before[5][1], before[65][1])


@pytest.mark.parametrize("kind", [Ball, BallHost])
def test_a_borrowed_host_is_not_part_of_the_module(kind):
    host = kind().eval()
    neilf = attach_neilf(host, tiny_config())
    mine = {id(p) for p in neilf.parameters()}
    assert not mine & {id(p) for p in host.parameters()}
    assert set(neilf.parameter_groups()) == {"brdf", "light"}
    assert mine == {id(p) for group in neilf.parameter_groups().values() for p in group}
    assert not any("radius" in name or "paint" in name for name in neilf.state_dict())
    neilf.train().double()
    assert not host.training
    assert host.radius.dtype == torch.float32


def test_before_the_material_stage_the_host_is_not_rendered():
    def unasked(origins, directions):
        raise AssertionError("asked")

    neilf = attach_neilf(unasked, tiny_config())
    total = neilf.losses(pixels(), 0)
    assert total.terms == {}
    total.loss.backward()  # a loop without a loss of its own may
    with pytest.raises(AssertionError, match="asked"):
        neilf.losses(pixels(), neilf.model.config.train.sdf_steps)


def test_steps_fall_into_the_stages_of_the_settings():
    neilf = attach_neilf(Ball(), steps(sdf=2, material=3, joint=1))
    names = [set(neilf.losses(pixels(), step).terms) for step in (1, 2, 4, 5, 99)]
    material = {"physical", "inter_reflection", "smoothness"}
    assert [n - {"lambertian"} for n in names] == [
        set(),
        material,
        material,
        material | {"volume"},
        material | {"volume"},
    ]
    assert set(neilf.losses(pixels(), Stage.JOINT).terms) == names[3]


def test_gradients_reach_a_borrowed_host_only_in_the_joint_stage():
    host = Ball()
    neilf = attach_neilf(host, steps(sdf=0, material=1, joint=1))
    neilf.losses(pixels(), Stage.MATERIAL_INIT).loss.backward()
    assert all(p.grad is None for p in host.parameters())
    joint = neilf.losses(pixels(), Stage.JOINT)
    joint.loss.backward()
    assert host.radius.grad.abs() > 0  # through position and normal
    assert all(p.grad.abs().max() > 0 for p in host.paint.parameters())  # through the colour


def test_a_preset_can_be_named():
    torch.manual_seed(0)
    named = attach_neilf(BallHost(), "fast").model.config
    assert named.preset == "fast"
    assert named.train.sdf_steps == 0
    assert attach_neilf(BallHost()).model.config == named
    with pytest.raises(UserError, match="unknown preset 'quick'"):
        attach_neilf(BallHost(), "quick")


def test_a_host_with_parameter_groups_is_trained_with_the_material():
    config = tiny_config()
    torch.manual_seed(0)
    host = VolSdfHost(config, SceneFacts("linear", 0.2, 3.0, "constant"))
    neilf = attach_neilf(host, config)
    assert set(neilf.parameter_groups()) == {"geometry", "beta", "radiance", "brdf", "light"}
    assert {id(p) for p in host.parameters()} < {id(p) for p in neilf.parameters()}
    batch = sphere_batch()
    torch.manual_seed(1)
    total = neilf.losses(batch, 0)
    torch.manual_seed(1)
    expected = weigh(neilf.model.losses(batch, Stage.SDF_INIT), active_losses(Stage.SDF_INIT, config))
    torch.testing.assert_close(total.loss, expected.loss)
    assert "eikonal" in total.terms


def test_a_mesh_learns_its_light_field_with_the_material():
    host = mesh_host(SPHERE)
    neilf = attach_neilf(host, mesh_config())
    assert set(neilf.parameter_groups()) == {"radiance", "brdf", "light"}
    neilf.losses(pixels(), 0).loss.backward()
    assert any(p.grad.abs().max() > 0 for p in host.parameters())


# -------------------------------------------------------------------------------------------------- the parts


def test_a_known_map_is_used_and_not_changed(tmp_path):
    known = np.random.default_rng(0).random((6, 12, 3), dtype=np.float32) + 0.5
    write_exr(tmp_path / "sky.exr", {"RGB": known})
    config = mesh_config()
    light = MapLightConfig(kind="distant", map=str(tmp_path / "sky.exr"))
    neilf = attach_neilf(mesh_host(SPHERE), dataclasses.replace(config, light=light))
    assert neilf.losses(pixels(), Stage.MATERIAL_INIT).loss.isfinite()
    shown = neilf.model.light.log_radiance.exp().permute(1, 2, 0)
    torch.testing.assert_close(shown, torch.from_numpy(known))


def test_in_an_open_scene_rays_that_miss_show_the_light():
    config, batch = solved_light(steps(sdf=0, material=4, joint=0)), pixels(spread=1.5)
    missed = (mesh_host(SPHERE).render(batch.rays).opacity == 0).sum()
    assert 0 < missed < len(batch)
    neilf = attach_neilf(mesh_host(SPHERE), config, open_scene=True).train()
    neilf.losses(batch, Stage.MATERIAL_INIT)
    assert neilf.light_solver.sky.pixels.sum() == missed
    assert attach_neilf(mesh_host(SPHERE), config).light_solver.sky is None


def test_shading_agrees_with_the_maps_and_is_zero_for_misses():
    neilf = attach_neilf(BallHost(), tiny_config()).eval()
    batch = pixels(spread=0.9)
    hits = neilf.model.host.render(batch.rays)
    shading, maps = neilf.shade(hits, -batch.directions), neilf.model.maps(batch.rays)
    hit = hits.opacity > 0
    assert 0 < hit.sum() < len(hit)
    torch.testing.assert_close(shading.color[hit], maps.rgb[hit])
    torch.testing.assert_close(shading.specular, maps.specular)
    assert not shading.color[~hit].any()


class TiltedBall(BallHost):
    """A ball that provides smoothed normals other than those of its hits."""

    def smooth_normals(self, position, normal):
        return torch.nn.functional.normalize(normal + torch.tensor([0.5, 0.0, 0.0]), dim=-1)


def test_shading_uses_the_normals_of_the_maps():
    neilf = attach_neilf(TiltedBall(), tiny_config()).eval()
    batch = pixels()
    hits = neilf.model.host.render(batch.rays)
    shading, maps = neilf.shade(hits, -batch.directions), neilf.model.maps(batch.rays)
    assert (maps.normal * hits.normal).sum(-1).median() < 0.95
    torch.testing.assert_close(shading.color, maps.rgb)


def test_material_and_light_at_points():
    neilf = attach_neilf(Ball(), tiny_config())
    x = torch.rand(5, 3)
    assert neilf.materials(x).base_color.shape == (5, 3)
    light = neilf.incident_light(x, torch.eye(3).expand(5, 3, 3))
    assert light.shape == (5, 3, 3)
    assert (light > 0).all()


def test_pixel_batches_without_masks():
    rays = ball_rays(4)
    color, mask = torch.rand(4, 3), torch.tensor([1.0, 0.0, 1.0, 1.0])
    plain, masked = (pixel_batch(rays.origins, rays.directions, color, m) for m in (None, mask))
    assert plain.mask.all()
    assert not plain.mask_known.any()
    assert torch.equal(masked.mask, mask)
    assert masked.mask_known.all()


# ----------------------------------------------------------------------------------------- what a host is not


def test_missing_capabilities_are_logged_once_in_one_line(caplog):
    with caplog.at_level(logging.WARNING):
        neilf = attach_neilf(Ball(), tiny_config())
        neilf.losses(pixels(), Stage.MATERIAL_INIT)
    (record,) = caplog.records
    lacking = {"render_regularized", "surface_width", "parameter_groups", "sdf", "scene_light"}
    assert set(neilf.missing) == lacking
    assert "attached to Ball" in record.message
    assert all(f"no {name}: {neilf.missing[name]}" in record.message for name in lacking)
    assert missing_capabilities(sphere_model().host) == {}


def test_a_nerfstudio_model_is_recognized_by_its_attributes(monkeypatch):
    class Adapter(BallHost):
        def __init__(self, model, response):
            super().__init__()
            object.__setattr__(self, "adapted", (model, response))

        def parameter_groups(self):
            return {"geometry": [self.radius]}

    class Model(nn.Module):
        config = SimpleNamespace()

        def get_outputs(self, bundle): ...

    stub = ModuleType("neilfpp_method.hosts.nerfstudio")
    stub.NerfstudioHost = Adapter
    monkeypatch.setitem(sys.modules, stub.__name__, stub)
    model = Model()
    neilf = attach_neilf(model, tiny_config(), response="srgb")
    assert neilf.model.host.inner.adapted == (model, "srgb")
    assert set(neilf.parameter_groups()) == {"brdf", "light"}  # it is trained by its own trainer


def test_a_wrapper_that_hides_the_methods_of_a_host_is_refused():
    """As a function it would call `forward`; around a plain function there is nothing to hide."""
    with pytest.raises(UserError, match=r"DataParallel hides the methods of BallHost; attach .*host\.module"):
        attach_neilf(nn.DataParallel(BallHost()), tiny_config())

    class TrainedBall(Ball):
        def parameter_groups(self):
            return {"geometry": [self.radius]}

    with pytest.raises(UserError, match="hides the methods of TrainedBall"):
        attach_neilf(nn.DataParallel(TrainedBall()), tiny_config())
    attach_neilf(nn.DataParallel(Ball()), tiny_config())


def test_anything_but_a_host_is_refused_by_name():
    with pytest.raises(UserError, match="list is not a host; give an object with render"):
        attach_neilf([1, 2, 3])


def spoiled(function):
    """The ball as a plain function whose result is replaced."""
    ball = Ball()

    def field(origins, directions):
        return function(*ball(origins, directions))

    return field


BAD_ANSWERS = [
    (lambda c, p, n: None, r"returns a NoneType; return color, position and normal, each \(N, 3\)"),
    (lambda c, p, n: (c, n), r"returns 2 values; return color, position and normal"),
    (lambda c, p, n: (c[:, :1], p, n), r"its color has the shape \(64, 1\); return \(64, 3\), a row per ray"),
    (lambda c, p, n: (c, p[1:], n), r"its position has the shape \(63, 3\)"),
    (lambda c, p, n: (c, p, n.norm(dim=-1)), r"its normal has the shape \(64,\)"),
    (lambda c, p, n: (c, p, n.detach().numpy()), r"its normal is a ndarray; return a floating-point tensor"),
    (lambda c, p, n: (c.to("meta"), p, n), r"its color is on meta, the rays are on cpu; move the host"),
    (lambda c, p, n: (c, p, 3.0 * n), r"its normal is not a unit vector: that of a hit has the length 3"),
]


@pytest.mark.parametrize(("answer", "message"), BAD_ANSWERS, ids=[message[:30] for _, message in BAD_ANSWERS])
def test_a_bad_answer_names_the_host_the_output_and_the_remedy(answer, message):
    neilf = attach_neilf(spoiled(answer), tiny_config())
    with pytest.raises(UserError, match=message) as caught:
        neilf.losses(pixels(), Stage.JOINT)
    assert "spoiled.<locals>.field" in caught.value.problem


def test_a_function_may_return_a_dictionary():
    ball = Ball()

    def dictionary(origins, directions):
        color, position, normal = ball(origins, directions)
        return {"rgb": color, "depth": (position - origins).norm(dim=-1), "normal": normal}

    rays = pixels().rays
    expected, found = CallableHost(ball).render(rays), CallableHost(dictionary).render(rays)
    hit = expected.is_hit(0.8)
    assert hit.any()
    torch.testing.assert_close(found.is_hit(0.8), hit)
    torch.testing.assert_close(found.position[hit], expected.position[hit])
    assert attach_neilf(dictionary, tiny_config()).losses(pixels(), Stage.MATERIAL_INIT).loss.isfinite()
    incomplete = attach_neilf(spoiled(lambda c, p, n: {"rgb": c}), tiny_config())
    with pytest.raises(UserError, match="its outputs have no tensor"):
        incomplete.losses(pixels(), Stage.MATERIAL_INIT)


@pytest.mark.parametrize("miss", [torch.inf, torch.nan, 1e10])
@pytest.mark.parametrize("names_opacity", [True, False])
def test_the_depth_of_a_ray_that_misses_is_not_read(miss, names_opacity):
    ball = Ball()

    def dictionary(origins, directions):
        color, position, normal = ball(origins, directions)
        opacity = (normal.norm(dim=-1) > 0.5).float()
        depth = torch.where(opacity > 0, (position - origins).norm(dim=-1), miss)
        outputs = {"rgb": color, "depth": depth, "normal": normal}
        return outputs | ({"accumulation": opacity[:, None]} if names_opacity else {})

    batch = pixels(spread=1.5)
    hits = CallableHost(dictionary).render(batch.rays)
    missed = hits.opacity == 0
    assert 0 < missed.sum() < len(missed)
    torch.testing.assert_close(hits.position[missed], batch.rays.origins[missed])
    loss = attach_neilf(dictionary, tiny_config()).losses(batch, Stage.JOINT).loss
    loss.backward()
    assert loss.isfinite()
    assert all(p.grad.isfinite().all() for p in ball.parameters() if p.grad is not None)


def test_a_color_without_gradient_is_accepted_if_it_is_not_trained():
    neilf = attach_neilf(spoiled(lambda c, p, n: (c.detach(), p, n)), tiny_config())
    assert neilf.losses(pixels(), Stage.MATERIAL_INIT).loss.isfinite()


def test_bad_normals_of_a_host_object_are_named():
    for spoil, message in (
        (lambda rays, o: {"normal": 0.0 * o["normal"]}, "BallHost: its normal is not a unit vector"),
        (
            lambda rays, o: {"normal": o["normal"] / 0.0},
            "BallHost: its normal is not finite for 64 of 64 rays; divide by",
        ),
        (
            lambda rays, o: {"opacity": o["opacity"][:, None]},
            r"BallHost: its opacity has the shape \(64, 1\)",
        ),
        (lambda rays, o: {"concentration": None}, "BallHost: its concentration is a NoneType"),
    ):
        with pytest.raises(UserError, match=message):
            attach_neilf(BallHost(spoil), tiny_config()).losses(pixels(), Stage.MATERIAL_INIT)


def test_normals_are_checked_until_the_first_hit_and_shapes_always():
    spoil = {}
    neilf = attach_neilf(
        BallHost(lambda rays, outputs: {n: f(outputs[n]) for n, f in spoil.items()}), tiny_config()
    )
    batch = pixels()
    away = dataclasses.replace(batch, directions=-batch.directions)
    neilf.losses(away, Stage.MATERIAL_INIT)
    spoil["normal"] = lambda n: 2.0 * n
    with pytest.raises(UserError, match="not a unit vector"):
        neilf.losses(batch, Stage.MATERIAL_INIT)
    spoil.clear()
    neilf.losses(batch, Stage.MATERIAL_INIT)
    spoil["normal"] = lambda n: 2.0 * n
    neilf.losses(batch, Stage.MATERIAL_INIT)
    spoil["normal"] = lambda n: n[:, :2]
    with pytest.raises(UserError, match="its normal has the shape"):
        neilf.losses(batch, Stage.MATERIAL_INIT)


def test_rays_and_fields_on_two_devices_are_named():
    neilf = attach_neilf(Ball(), tiny_config())
    with pytest.raises(UserError, match="rays on meta, material and light on cpu; move one of them"):
        neilf.losses(pixels().to("meta"), Stage.MATERIAL_INIT)


def test_the_parts_are_on_the_device_of_the_host():
    """The meta device stands for a GPU: tensors there have no values."""
    neilf = attach_neilf(BallHost().to("meta"), tiny_config())
    assert {p.device.type for p in neilf.parameters()} == {"meta"}
    assert {p.device.type for p in attach_neilf(BallHost(), tiny_config()).parameters()} == {"cpu"}
