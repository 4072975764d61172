"""Hits that are rendered already, hosts that draw images, and the messages and side effects of an
attachment.
"""

from __future__ import annotations

import dataclasses
import logging

import numpy as np
import pytest
import torch

from neilfpp_method.attach import attach_neilf, pixel_batch
from neilfpp_method.data.cameras.camera import Camera
from neilfpp_method.data.cameras.projection import camera_rays
from neilfpp_method.errors import UserError
from neilfpp_method.hosts import foreign
from neilfpp_method.hosts.function import CallableHost
from neilfpp_method.hosts.image import image_hits
from neilfpp_method.schedule import Stage
from neilfpp_method.settings.presets import preset
from neilfpp_method.structures import PixelBatch, RayBatch, SurfaceHits
from tests.hosts.balls import Ball, BallHost, ball_rays
from tests.hosts.table import TableTop
from tests.scenes import tiny_config


@pytest.fixture(autouse=True)
def coarse(monkeypatch):
    """A grid of which few rays fill all cells."""
    monkeypatch.setattr(foreign, "GRID_RESOLUTION", 40)


def pixels(rays: RayBatch) -> PixelBatch:
    return pixel_batch(rays.origins, rays.directions, torch.tensor([[0.4, 0.2, 0.1]]).expand(len(rays), 3))


def hard_config():
    """The preset `fast`, tiny, with its map and traced rays."""
    config, fast = tiny_config(), preset("fast")
    return dataclasses.replace(
        config,
        light=dataclasses.replace(fast.light, kind="distant", environment_height=8),
        train=dataclasses.replace(config.train, sdf_steps=0),
    )


class Counted(Ball):
    """The ball as a function that counts the rays that it renders."""

    asked = 0

    def forward(self, origins, directions):
        assert len(origins) > 0
        self.asked += len(origins)
        return super().forward(origins, directions)


# --------------------------------------------------------------------------------------------- hits handed in


@pytest.mark.parametrize("form", ["hits", "dictionary", "tuple"])
def test_given_hits_are_not_rendered_again_and_give_the_same_losses(form):
    host, rays = Counted(), ball_rays(64, 0.8)
    config = tiny_config()
    config = dataclasses.replace(config, light=dataclasses.replace(config.light, inter_reflection="off"))
    neilf = attach_neilf(host, config)
    color, position, normal = host(rays.origins, rays.directions)
    depth = ((position - rays.origins) * rays.directions).sum(-1, keepdim=True)
    given = {
        "hits": CallableHost(host).render(rays),
        "dictionary": {
            "rgb": color,
            "depth": depth,
            "normal": normal,
            "accumulation": normal.detach().norm(dim=-1),
        },
        "tuple": (color, position, normal),
    }[form]
    host.asked = 0
    torch.manual_seed(0)
    handed = neilf.losses(pixels(rays), "joint", given)
    assert host.asked == 0
    torch.manual_seed(0)
    rendered = neilf.losses(pixels(rays), Stage.JOINT)
    assert host.asked == 64
    assert set(handed.terms) == set(rendered.terms)
    torch.testing.assert_close(handed.loss, rendered.loss, rtol=1e-4, atol=1e-6)
    handed.loss.backward()
    assert host.radius.grad.abs() > 0


def test_maps_of_given_hits_agree_with_rendered_rays():
    host, rays = Counted(), ball_rays(40, 0.8)
    neilf = attach_neilf(host, tiny_config()).eval()
    hits = CallableHost(host).render(rays)
    host.asked = 0
    handed = neilf.maps(rays, hits)
    assert host.asked == 0
    rendered = neilf.maps(rays)
    for field in dataclasses.fields(handed):
        torch.testing.assert_close(getattr(handed, field.name), getattr(rendered, field.name))


def test_no_gradients_flow_through_hits_in_the_material_stage():
    host, rays = Ball(), ball_rays(64)
    attach_neilf(host, tiny_config()).losses(
        pixels(rays), "material_init", CallableHost(host).render(rays)
    ).loss.backward()
    assert all(p.grad is None for p in host.parameters())


def test_outputs_without_a_normal_are_named():
    rays = ball_rays(4)
    with pytest.raises(
        UserError, match=r"Ball: its outputs have no tensor 'normal' or 'normals', but rgb, depth; add one"
    ):
        attach_neilf(Ball(), tiny_config()).losses(
            pixels(rays), "joint", {"rgb": rays.origins, "depth": rays.origins[:, 0]}
        )


# -------------------------------------------------------------------------------------- hosts of whole images


def camera(size: int = 40) -> Camera:
    """From (0, −2.5, 1) towards the origin, z up."""
    eye = np.array([0.0, -2.5, 1.0])
    forward = -eye / np.linalg.norm(eye)
    right = np.array([1.0, 0.0, 0.0])
    rotation = np.stack([right, np.cross(forward, right), forward])
    w2c = np.eye(4)
    w2c[:3, :3], w2c[:3, 3] = rotation, -rotation @ eye
    return Camera(1.2 * size, 1.2 * size, size / 2, size / 2, size, size, w2c)


class Splats:
    """A rasteriser: colour, z-depth and opacity of a whole view, without rays and normals."""

    def __init__(self) -> None:
        self.scene = TableTop()

    def render_image(self, view: Camera) -> SurfaceHits:
        rays = camera_rays(view)
        distance = self.scene.meet(rays.origins, rays.directions)
        color, *_ = self.scene(rays.origins, rays.directions)
        forward = torch.tensor(view.w2c[2, :3], dtype=torch.float32)
        depth = torch.where(distance.isfinite(), distance, 0.0) * (rays.directions @ forward)
        size = (view.height, view.width)
        opacity = distance.isfinite().float().view(size)
        return image_hits(view, color.view(*size, 3), depth.view(size), opacity)


def test_maps_of_an_image_are_hits_with_normals_from_depth():
    view = camera(120)
    hits, rays = Splats().render_image(view), camera_rays(view)
    _, position, normal = TableTop()(rays.origins, rays.directions)
    hit = hits.is_hit(0.8)
    assert 0.2 < hit.float().mean() < 0.9
    torch.testing.assert_close(hits.position[hit], position[hit], atol=1e-4, rtol=0)
    angle = (hits.normal[hit] * normal[hit]).sum(-1).clamp(-1, 1).acos().rad2deg()
    assert angle.median() < 2
    assert (angle < 15).float().mean() > 0.9


def test_colors_in_half_precision_leave_positions_precise():
    view = camera(24)
    size, rays = (24, 24), camera_rays(view)
    forward = torch.tensor(view.w2c[2, :3], dtype=torch.float32)
    depth = torch.full(size, 2.0)
    hits = image_hits(view, torch.ones(*size, 3).half(), depth, torch.ones(size).half())
    position = rays.origins + (2.0 / (rays.directions @ forward))[:, None] * rays.directions
    torch.testing.assert_close(hits.position, position, atol=1e-5, rtol=0)


def test_a_material_is_learned_from_given_image_hits():
    torch.manual_seed(0)
    view, host = camera(), Splats()
    neilf = attach_neilf(host, hard_config(), median_radiance=0.3)
    with pytest.raises(UserError, match="Splats draws whole images, not rays; pass its hits"):
        neilf.losses(pixels(camera_rays(view)), 0)
    rays, hits = camera_rays(view), host.render_image(view)
    batch = pixel_batch(rays.origins, rays.directions, hits.color)
    optimizer = torch.optim.Adam([{"params": g["params"], "lr": 3e-3} for g in neilf.param_groups()])
    physical = []
    for _ in range(60):
        rows = torch.randperm(len(batch))[:200]
        total = neilf.losses(batch[rows], "material_init", hits[rows])
        optimizer.zero_grad()
        total.loss.backward()
        optimizer.step()
        physical.append(total.terms["physical"].item())
    assert sum(physical[-3:]) < 0.8 * sum(physical[:3])
    maps = neilf.eval().maps(view)
    assert maps.rgb.shape == (1600, 3)
    assert (maps.roughness > 0).any()
    up = torch.tensor([[0.0, 0.0, 1.0]])
    below, above = torch.tensor([[0.1, 0.0, -0.3]]), torch.tensor([[0.1, 0.0, 0.4]])
    assert neilf.proxy.scene_light(below, up[None]).hit.item()  # on the table, beneath the ball
    assert not neilf.proxy.scene_light(above, up[None]).hit.item()


def test_a_host_without_secondary_rays_renders_only_camera_rays():
    class Primary(BallHost):
        answers_secondary_rays = False

        def render(self, rays):
            assert torch.allclose(rays.origins.norm(dim=-1), torch.tensor(3.0))
            return super().render(rays)

    host = Primary()
    for config in (hard_config(), tiny_config()):
        neilf = attach_neilf(host, config)
        for _ in range(3):
            total = neilf.losses(pixels(ball_rays(64, 0.8)), Stage.JOINT)
        total.loss.backward()
        assert total.loss.isfinite()
        assert neilf.maps(ball_rays(16)).rgb.isfinite().all()


# ------------------------------------------------------------------------------------------ what is untouched


def test_a_host_is_never_called_without_rays():
    host = Counted()
    for config in (tiny_config(), hard_config()):
        neilf = attach_neilf(host, config)
        away = ball_rays(32)
        away = RayBatch(away.origins, -away.directions)
        for rays in (away, away[:0], ball_rays(32)):
            assert neilf.losses(pixels(rays), "material_init").loss.isfinite()
        assert len(neilf.maps(away[:0]).rgb) == 0


def test_attaching_keeps_the_random_state():
    host = Ball()
    torch.manual_seed(7)
    expected = torch.rand(3)
    for config in ("fast", tiny_config()):
        torch.manual_seed(7)
        attach_neilf(host, config)
        assert torch.equal(torch.rand(3), expected)


def test_groups_of_parameters_have_the_rates_of_the_settings():
    config = tiny_config()
    neilf = attach_neilf(Ball(), config)
    optimizer = torch.optim.Adam(Ball().parameters(), lr=1.0)
    for group in neilf.param_groups():
        optimizer.add_param_group(group)
    rates = {group.get("name"): group["lr"] for group in optimizer.param_groups[1:]}
    assert rates == {"brdf": config.optimizer.brdf, "light": config.optimizer.light}
    mapped = attach_neilf(Ball(), hard_config()).param_groups()  # a map is fitted and has no parameters
    assert [group["name"] for group in mapped] == ["brdf"]


# ----------------------------------------------------------------------------------------------- what is said


def test_a_borrowed_host_starts_with_the_material_or_logs_its_step(caplog):
    with caplog.at_level(logging.WARNING):
        now = attach_neilf(Ball())
        attach_neilf(Ball(), tiny_config())
    first, second = (record.message for record in caplog.records)
    assert now.model.config.train.sdf_steps == 0
    assert (
        "Ball: the material is trained from step 0; the host gets gradients from step 3000; "
        "a proxy of its surface" in first
    )
    assert "nothing is computed before step 4 (train.sdf_steps)" in second
    assert now.model.config.light.kind == "auto"  # the light of the preset, on any host
    assert now.proxy is not None


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"response": "sRGB"}, "response 'sRGB'; choose linear"),
        ({"median_radiance": 0.0}, "median_radiance is 0.0; give the median linear luminance"),
        ({"median_radiance": float("nan")}, "median_radiance is nan"),
        ({"radiance_scale": -1.0}, "radiance_scale is -1.0"),
    ],
)
def test_impossible_facts_are_refused_by_name(arguments, message):
    with pytest.raises(UserError, match=message):
        attach_neilf(Ball(), tiny_config(), **arguments)


def test_a_stage_is_one_of_three():
    neilf = attach_neilf(Ball(), tiny_config())
    with pytest.raises(
        UserError,
        match="unknown stage 'late'; give the index of the step, or one of sdf_init, material_init",
    ):
        neilf.losses(pixels(ball_rays(4)), "late")
    with pytest.raises(UserError, match="step -1; count steps from 0"):
        neilf.losses(pixels(ball_rays(4)), -1)
    assert set(neilf.losses(pixels(ball_rays(32)), "joint").terms) >= {"volume", "physical"}


@pytest.mark.parametrize("dtype", [torch.float64, torch.float16, torch.bfloat16])
def test_a_host_of_another_precision_is_converted_and_half_is_warned_about(dtype, caplog):
    host = BallHost(lambda rays, outputs: {name: value.to(dtype) for name, value in outputs.items()})
    neilf = attach_neilf(host, tiny_config())
    with caplog.at_level(logging.WARNING, "neilfpp_method.hosts"):
        for _ in range(2):
            loss = neilf.losses(pixels(ball_rays(32)), "joint").loss
    loss.backward()
    assert loss.dtype == torch.float32
    assert host.radius.grad.isfinite()
    said = [record.message for record in caplog.records if "position is torch" in record.message]
    assert len(said) == (dtype != torch.float64)


def test_a_depth_in_half_precision_is_warned_about_once(caplog):
    """Positions are computed from it in single precision, and are as coarse as it is."""
    ball = Ball()

    def host(origins, directions):
        color, position, normal = ball(origins, directions)
        depth = (position - origins).norm(dim=-1)
        return {"rgb": color.half(), "depth": depth.half(), "normal": normal.half()}

    neilf = attach_neilf(host, tiny_config())
    with caplog.at_level(logging.WARNING, "neilfpp_method.hosts"):
        for _ in range(2):
            neilf.losses(pixels(ball_rays(32)), "material_init")
    (said,) = [record.message for record in caplog.records if "relative precision" in record.message]
    assert "its depth is torch.float16, whose relative precision is 1e-03; return depths in float32" in said


def test_rays_of_another_precision_are_refused():
    rays = ball_rays(4)
    batch = pixels(RayBatch(rays.origins.double(), rays.directions.double()))
    with pytest.raises(
        UserError, match=r"rays are torch.float64, material and light torch.float32; give rays.float\(\)"
    ):
        attach_neilf(Ball(), tiny_config()).losses(batch, "joint")
