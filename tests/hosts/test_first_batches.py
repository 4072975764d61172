"""Mistakes of a host or a loop are reported at the first batches, once, with the remedy."""

from __future__ import annotations

import dataclasses
import logging

import pytest
import torch
from torch.nn.functional import normalize

from neilfpp_method.attach import attach_neilf, pixel_batch
from neilfpp_method.errors import UserError
from neilfpp_method.hosts.batches import check_points
from neilfpp_method.hosts.first_batches import BATCHES
from neilfpp_method.structures import RayBatch
from tests.hosts.balls import Ball, BallHost, ball_rays
from tests.scenes import tiny_config
from tests.train.small_runs import solved_light

SAYS = "neilfpp_method.hosts.first_batches"


def batch(rays: RayBatch, color: float = 0.4):
    return pixel_batch(rays.origins, rays.directions, torch.full((len(rays), 3), color))


def shifted(x: torch.Tensor, by: torch.Tensor) -> RayBatch:
    return RayBatch(x.origins + by, x.directions)


def beside(rays: RayBatch, outputs: dict) -> dict:
    return {"position": outputs["position"] + torch.tensor([0.0, 5.0, 0.0])}


def first_nan(rays: RayBatch, outputs: dict, name: str) -> dict:
    return {name: torch.where(torch.arange(len(rays))[:, None] == 0, torch.nan, outputs[name])}


ERRORS = [
    (
        lambda r, o: first_nan(r, o, "position"),
        "BallHost: its position is not finite for 1 of 64 rays; return zeros",
    ),
    (lambda r, o: first_nan(r, o, "color"), "BallHost: its color is not finite for 1 of 64 rays"),
    (
        lambda r, o: {"normal": -o["normal"]},
        "BallHost: 100% of its normals point away from the viewer; turn them outwards",
    ),
    (
        beside,
        "BallHost: 100% of its hits do not lie on their rays; return positions in the frame of the rays",
    ),
]


@pytest.mark.parametrize(("spoil", "message"), ERRORS, ids=[message[10:40] for _, message in ERRORS])
def test_unusable_hits_are_an_error(spoil, message):
    neilf = attach_neilf(BallHost(spoil), tiny_config())
    with pytest.raises(UserError, match=message):
        neilf.losses(batch(ball_rays(64)), "material_init")


def test_a_correct_host_passes_without_messages(caplog):
    neilf = attach_neilf(BallHost(), tiny_config())
    with caplog.at_level(logging.WARNING, SAYS):
        for seed in range(BATCHES + 2):
            neilf.losses(batch(ball_rays(64, seed=seed)), "joint")
    assert not [record for record in caplog.records if record.name == SAYS]


def test_no_hit_in_a_batch_is_warned_about_once(caplog):
    rays = ball_rays(64)
    away = RayBatch(rays.origins, -rays.directions)
    neilf = attach_neilf(Ball(), tiny_config())
    with caplog.at_level(logging.WARNING, SAYS):
        for _ in range(3):
            neilf.losses(batch(away), "material_init")
    (record,) = (record for record in caplog.records if record.name == SAYS)
    assert (
        "Ball: none of 64 rays hits a surface, so material and light are not trained; are the rays"
        in record.message
    )


def test_a_scene_far_outside_the_unit_sphere_is_warned_about_once(caplog):
    by, ball = torch.tensor([6.0, 0.0, 0.0]), Ball()

    def far(origins, directions):
        color, position, normal = ball(origins - by, directions)
        return color, position + by, normal

    neilf = attach_neilf(far, tiny_config())
    with caplog.at_level(logging.WARNING, SAYS):
        for _ in range(3):
            neilf.losses(batch(shifted(ball_rays(64), by)), "material_init")
    (record,) = (record for record in caplog.records if record.name == SAYS)
    assert "half of its hits are" in record.message
    assert "move and scale cameras and host so that the object lies in the unit sphere" in record.message


def test_z_depth_is_warned_about_once(caplog):
    """A ball with z-depth from close cameras that look at its centre; positions lie on their rays."""

    def z_depth(rays: RayBatch, outputs: dict) -> dict:
        axis = normalize(-rays.origins, dim=-1)
        cosine = (axis * rays.directions).sum(-1, keepdim=True)
        return {"position": rays.origins + cosine * (outputs["position"] - rays.origins)}

    said = "% of its hits are 0.01 or more away when seen from another viewpoint; return distances along"
    neilf, true = (attach_neilf(host, tiny_config()) for host in (BallHost(z_depth), BallHost()))
    with caplog.at_level(logging.WARNING, SAYS):
        for seed in range(3):
            rays = ball_rays(256, spread=0.6, seed=seed)
            close = 0.4 * rays.origins
            rays = RayBatch(close, normalize(0.5 * rays.directions.roll(1, 0) - close, dim=-1))
            true.losses(batch(rays), "material_init")
            neilf.losses(batch(rays), "material_init")
    (record,) = (record for record in caplog.records if record.name == SAYS)
    assert said in record.message


def near_plane(rays: RayBatch, outputs: dict) -> dict:
    depth = (outputs["position"] - rays.origins).norm(dim=-1)
    seen = outputs["concentration"] * (depth > 0.2)
    return {"opacity": seen, "concentration": seen}


def test_a_near_plane_is_warned_about_if_the_host_renders_rays_between_surfaces(caplog):
    hosts = {"near": BallHost(near_plane), "true": BallHost(), "proxy": BallHost(near_plane)}
    settings = {"near": tiny_config(), "true": tiny_config(), "proxy": solved_light(tiny_config())}
    said = {}
    for kind, host in hosts.items():
        neilf = attach_neilf(host, settings[kind])
        caplog.clear()
        with caplog.at_level(logging.WARNING, SAYS):
            for seed in range(2):
                neilf.losses(batch(ball_rays(64, seed=seed)), "material_init")
        said[kind] = [record.message for record in caplog.records if "near plane" in record.message]
    assert said["true"] == said["proxy"] == []
    (message,) = said["near"]
    assert "100% of its hits are lost when seen from 0.05 away" in message
    assert "set light.inter_reflection to 'hard'" in message


def test_the_check_from_another_viewpoint_keeps_the_random_state():
    """The host draws random numbers; training draws the same numbers with and without the check."""

    def drawn(rays: RayBatch, outputs: dict) -> dict:
        torch.rand(7)
        return {}

    def after_a_step(render: bool) -> torch.Tensor:
        neilf = attach_neilf(BallHost(drawn), tiny_config())
        assert neilf.first_batches.render is not None
        neilf.first_batches.render = neilf.first_batches.render if render else None
        torch.manual_seed(3)
        neilf.losses(batch(ball_rays(64)), "material_init")
        return torch.rand(4)

    assert torch.equal(after_a_step(render=True), after_a_step(render=False))


def test_a_host_of_camera_rays_is_not_rendered_from_another_viewpoint():
    host = BallHost()
    host.answers_secondary_rays = False
    assert attach_neilf(host, tiny_config()).first_batches.render is None


def test_directions_that_are_not_unit_are_an_error():
    rays = ball_rays(8)
    neilf = attach_neilf(Ball(), tiny_config())
    with pytest.raises(
        UserError, match=r"ray directions are not unit vectors: their lengths are between 2 and 2; divide"
    ):
        neilf.losses(batch(RayBatch(rays.origins, 2.0 * rays.directions)), "joint")


def test_pixels_that_are_not_finite_are_an_error():
    spoiled = batch(ball_rays(8))
    spoiled = dataclasses.replace(
        spoiled, color=torch.where(torch.arange(8)[:, None] < 2, torch.inf, spoiled.color)
    )
    with pytest.raises(UserError, match="color of 2 of 8 pixels are not finite; leave those pixels out"):
        attach_neilf(Ball(), tiny_config()).losses(spoiled, "joint")


def test_display_values_above_one_are_an_error_and_a_wrong_median_a_warning(caplog):
    with pytest.raises(
        UserError, match=r"pixels reach 128, but display values are at most 1; divide 8-bit pixels by 255"
    ):
        attach_neilf(Ball(), tiny_config(), response="srgb").losses(batch(ball_rays(8), 128.0), "joint")
    neilf = attach_neilf(Ball(), tiny_config())
    with caplog.at_level(logging.WARNING, SAYS):
        for _ in range(2):
            neilf.losses(batch(ball_rays(8), 128.0), "material_init")
    (record,) = (record for record in caplog.records if record.name == SAYS)
    assert "the median of the pixels is 128, but median_radiance means 0.5" in record.message


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"color": torch.zeros(4, 3, dtype=torch.uint8)},
            "color of the batch is torch.uint8; divide 8-bit pixels by 255",
        ),
        (
            {"mask": torch.ones(4, 1)},
            r"mask of the batch has the shape \(4, 1\); give \(4,\): one number per pixel",
        ),
        ({"color": torch.zeros(4)}, r"color of the batch has the shape \(4,\); give \(4, 3\)"),
        (
            {"directions": torch.zeros(2, 2, 3)},
            r"the shape \(2, 2, 3\); give \(4, 3\): one row per pixel, reshape\(-1, 3\)",
        ),
    ],
)
def test_pixels_of_another_form_are_named(change, message):
    rays = ball_rays(4)
    parts = {
        "origins": rays.origins,
        "directions": rays.directions,
        "color": torch.rand(4, 3),
        "mask": torch.ones(4),
    }
    with pytest.raises(UserError, match=message):
        pixel_batch(**(parts | change))


def test_points_of_an_image_are_named():
    with pytest.raises(
        UserError, match=r"x has the shape \(2, 2, 3\), not \(N, 3\); give x.reshape\(-1, 3\)"
    ):
        check_points("x", torch.zeros(2, 2, 3))
    with pytest.raises(UserError, match=r"wi has the shape \(4, 3\), not \(N, S, 3\)"):
        check_points("wi", torch.zeros(4, 3), axes=3)
    with pytest.raises(UserError, match=r"x is torch\.int64; give floats"):
        check_points("x", torch.zeros(2, 3, dtype=torch.long))
