"""Inaccurate camera poses are detected, corrected by alignment, and applied wherever cameras are used."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.nn.functional import normalize

from neilfpp_method.data.cameras.projection import camera_rays
from neilfpp_method.data.capture import Capture, load_capture
from neilfpp_method.data.pixels.dataset import PixelDataset
from neilfpp_method.effects.evidence.poses import pixel_angles
from neilfpp_method.effects.plan import Plan
from neilfpp_method.effects.pose_fit import _render, fit_poses
from neilfpp_method.effects.request import check_effects, parse_effects
from neilfpp_method.effects.review import POSE_STEPS, review_poses
from neilfpp_method.errors import UserError
from neilfpp_method.fields.poses import PoseCorrections, PoseMotion
from neilfpp_method.model import NeilfModel
from neilfpp_method.settings.facts import SceneFacts
from neilfpp_method.settings.plain import changed
from neilfpp_method.settings.presets import fixed_geometry, preset
from neilfpp_method.shading.color import apply_response
from neilfpp_method.structures import PixelBatch, RayBatch, SurfaceHits
from neilfpp_method.train.poses import camera_centers, corrected
from tests.data.make_capture import RADIUS, SCALE, make_capture, radiance
from tests.scenes import meet_ball, tiny_config

VIEWS, BALL = 8, RADIUS / SCALE


class Ball:
    """The ball of `make_capture`, exactly."""

    def render(self, rays: RayBatch) -> SurfaceHits:
        position, hit = meet_ball(rays, BALL)
        normal = normalize(position, dim=-1)
        color = torch.from_numpy(radiance(normal.double().numpy())).to(position) * hit[:, None]
        return SurfaceHits(color, position, normal * hit[:, None], hit, hit)


class Slope:
    """A tilted plane with smooth colours, which do not depend on the viewer."""

    def render(self, rays: RayBatch) -> SurfaceHits:
        normal = normalize(torch.tensor([[0.3, -0.5, 1.0]]).to(rays.origins), dim=-1)
        distance = -(rays.origins * normal).sum(-1) / (rays.directions * normal).sum(-1)
        position = rays.origins + distance[:, None] * rays.directions
        ones = torch.ones_like(distance)
        return SurfaceHits(0.5 + 0.2 * (3 * position).sin(), position, normal.expand_as(position), ones, ones)


def model_of(host, response: str = "linear", median: float = 1.0) -> NeilfModel:
    config = changed(tiny_config(), {"train.pose_fits": 4})
    return NeilfModel(host, config, SceneFacts(response, median, 3.0, "constant"), borrowed=True)


def motions(degrees: float, views: int = VIEWS, seed: int = 0) -> PoseMotion:
    """Random turns of this root mean square, and shifts by which the origin moves as far in the image."""
    generator = torch.Generator().manual_seed(seed)
    turn, shift = torch.randn(2, views, 3, generator=generator) * np.radians(degrees) / 3**0.5
    return PoseMotion(turn, 3 * shift)


def disturbed(capture: Capture, motion: PoseMotion) -> Capture:
    """The capture with inaccurate poses of its training views."""
    poses = PoseCorrections(len(capture.train_views))
    poses.set(motion)
    return corrected(capture, poses)


def displacement(motion: PoseMotion, centers: torch.Tensor) -> torch.Tensor:
    """Angles, in degrees, by which the middle of the scene is displaced in each image. (V,)"""
    own = motion.without_common_motion(centers)
    forward, distance = -normalize(centers, dim=-1), centers.norm(dim=-1, keepdim=True)
    across = own.shift - (own.shift * forward).sum(-1, keepdim=True) * forward
    return (torch.linalg.cross(own.rotation, forward) + across / distance).norm(dim=-1).rad2deg()


def rms(values: torch.Tensor) -> float:
    return float(values.square().mean().sqrt())


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    root = tmp_path_factory.mktemp("captures") / "ball"
    return load_capture(make_capture(root, VIEWS, (64, 48), masks=True, test=None), test_every=0)


def test_motions_that_all_cameras_share_are_removed(ball):
    centers = camera_centers(ball)
    turn, shift, growth = torch.tensor([0.01, -0.02, 0.03]), torch.tensor([0.1, 0.0, -0.2]), 0.05
    moved = torch.linalg.cross(turn.expand_as(centers), centers) + shift + growth * centers
    common = PoseMotion(turn.expand_as(centers), moved)
    own = motions(1.0).without_common_motion(centers)
    both = PoseMotion(common.rotation + own.rotation, common.shift + own.shift)
    rest = both.without_common_motion(centers)
    torch.testing.assert_close(rest.rotation, own.rotation, atol=1e-6, rtol=0.0)
    torch.testing.assert_close(rest.shift, own.shift, atol=1e-6, rtol=0.0)


def test_rays_and_cameras_move_alike(ball):
    motion = motions(3.0)
    moved, pixels = disturbed(ball, motion), PixelDataset(ball, ball.train_views)
    batch = pixels.view(2)
    rays, expected = motion.of(batch).rays, camera_rays(moved.scene_camera(moved.train_views[2]))
    torch.testing.assert_close(rays.directions, expected.directions, atol=1e-6, rtol=0.0)
    torch.testing.assert_close(rays.origins, expected.origins, atol=1e-6, rtol=0.0)
    torch.testing.assert_close(pixels.posed(moved).view(2).directions, rays.directions, atol=1e-6, rtol=0.0)
    assert (rays.directions - batch.directions).abs().max() > 0.01


def test_corrections_apply_to_training_views_only(tmp_path):
    capture = load_capture(make_capture(tmp_path / "ball", 6, test=(0, 3)))
    moved = disturbed(capture, motions(3.0, views=4))
    for before, after in zip(capture.test_views, moved.test_views, strict=True):
        assert np.array_equal(before.camera.w2c, after.camera.w2c)
    for before, after in zip(capture.train_views, moved.train_views, strict=True):
        assert np.abs(before.camera.w2c - after.camera.w2c).max() > 1e-3
    assert corrected(capture, None) is capture
    still = corrected(capture, PoseCorrections(4))
    assert all(a.camera is b.camera for a, b in zip(capture.views, still.views, strict=True))


@pytest.mark.parametrize("axis", range(6))
def test_the_derivative_by_a_motion_is_that_of_finite_differences(axis):
    generator = torch.Generator().manual_seed(0)
    count, size = 40, 1e-4
    target = torch.rand(count, 3, generator=generator, dtype=torch.float64) - 0.5
    origins = torch.tensor([[0.3, -0.4, 3.0]], dtype=torch.float64).expand(count, 3)
    ones, none = torch.ones(count), torch.zeros(count)
    directions = normalize(target - origins, dim=-1)
    batch = PixelBatch(origins, directions, target, ones, none, none, torch.zeros(count, dtype=torch.long))
    pixel = torch.tensor([1e-4], dtype=torch.float64)
    model, step = model_of(Slope()), torch.zeros(1, 6, dtype=torch.float64)
    step[0, axis] = size

    def value(motion: torch.Tensor) -> torch.Tensor:
        return _render(model, PoseMotion(motion[:, :3], motion[:, 3:]).of(batch), pixel).value

    difference = (value(step) - value(-step)) / (2 * size)
    slope = _render(model, batch, pixel).slope[..., axis]
    assert difference.abs().max() > 0.02
    torch.testing.assert_close(slope, difference, atol=5e-4, rtol=1e-3)


@pytest.mark.parametrize("response", ["linear", "srgb"])
def test_a_known_scene_gives_the_poses(response):
    generator = torch.Generator().manual_seed(0)
    turn = torch.arange(VIEWS) * 2 * torch.pi / VIEWS
    centers = torch.stack((1.5 * turn.cos(), 1.5 * turn.sin(), 2.0 + 0.5 * turn.cos()), -1)
    view = torch.arange(VIEWS).repeat_interleave(80)
    origins = centers[view]
    directions = normalize(torch.rand(len(view), 3, generator=generator) - 0.5 - origins, dim=-1)
    color = apply_response(Slope().render(RayBatch(origins, directions)).color, response)
    ones, none, noise = torch.ones(len(view)), torch.zeros(len(view)), motions(1.0)
    given = noise.of(PixelBatch(origins, directions, color, ones, none, none, view))
    motion = PoseMotion.none(VIEWS)
    for _ in range(4):
        motion = fit_poses(model_of(Slope(), response), given, motion, torch.full((VIEWS,), 0.004))
    left = PoseMotion(noise.rotation + motion.rotation, noise.shift + motion.shift)
    assert rms(displacement(left, centers)) < 0.25 * rms(displacement(noise, centers))


def test_rays_keep_their_precision_whatever_numbers_the_focal_lengths_are(ball):
    """A capture in Blender's layout has focal lengths of NumPy's float64."""
    views = [
        replace(v, camera=replace(v.camera, fx=np.float64(v.camera.fx), fy=np.float64(v.camera.fy)))
        for v in ball.train_views
    ]
    pixels = PixelDataset(ball, views)
    assert pixel_angles(pixels).dtype == torch.float32
    batch, given = pixels.numbered(pixels.draw(20)), []

    class Checked(Ball):
        def render(self, rays: RayBatch) -> SurfaceHits:
            given.append(rays.directions.dtype)
            return super().render(rays)

    _render(model_of(Checked()), batch, pixel_angles(pixels).double())
    assert set(given) == {torch.float32}


def test_a_view_without_pixels_keeps_its_pose(ball):
    pixels = PixelDataset(ball, ball.train_views)
    batch, start = pixels.view(3), motions(0.5)
    moved = fit_poses(model_of(Ball()), batch, start, torch.full((VIEWS,), 0.02))
    others = torch.arange(VIEWS) != 3
    assert torch.equal(moved.rotation[others], start.rotation[others])
    assert not torch.equal(moved.rotation[3], start.rotation[3])


@pytest.mark.parametrize(("degrees", "on"), [(0.0, False), (1.0, True)])
def test_evidence_decides(ball, degrees, on):
    capture = disturbed(ball, motions(degrees))
    plan, model = Plan.begin(parse_effects("auto"), preset("fast")), model_of(Ball())
    assert plan.is_open("poses")
    torch.manual_seed(0)
    pixels = PixelDataset(capture, capture.train_views)
    (decision,) = review_poses(plan, model, pixels, 600)
    assert (decision.on, decision.by, decision.step) == (on, "evidence", 600)
    assert decision.evidence.samples >= 20
    assert plan.config.train.pose_fits == (12 if on else 0)
    assert plan.config_of_model.train.pose_fits == 12
    assert review_poses(plan, model, pixels, 700) == []


def test_nothing_is_concluded_from_a_blurred_model(ball):
    capture = disturbed(ball, motions(1.0))
    plan, model = Plan.begin(parse_effects("auto"), preset("fast")), model_of(Ball())
    pixels = PixelDataset(capture, capture.train_views)
    (decision,) = review_poses(plan, model, pixels, POSE_STEPS - 1)
    assert not decision.on
    assert decision.reason.startswith("not measured: R is blurred")
    assert review_poses(plan, model, pixels, POSE_STEPS) == []


def test_poses_are_not_fitted_to_a_given_surface():
    config = fixed_geometry(preset("fast"))
    assert config.train.pose_fits == 0
    with pytest.raises(UserError, match="the surface is given"):
        check_effects(parse_effects("+poses"), config)
    without = changed(preset("fast"), {"train.sdf_steps": 0})
    with pytest.raises(UserError, match="SDF init, which has no steps"):
        check_effects(parse_effects("+poses"), without)


def test_poses_can_be_corrected_or_not_by_name():
    for effects, fits in (("auto,+poses", 12), ("auto,-poses", 0), ("none", 0)):
        plan = Plan.begin(parse_effects(effects), preset("fast"))
        assert plan.newest("poses").by == "option"
        assert plan.config_of_model.train.pose_fits == fits
    assert Plan.begin(parse_effects("+poses"), preset("paper-mlp")).config.train.pose_fits == 12
