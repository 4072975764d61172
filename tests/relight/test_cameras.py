"""Cameras of relit images."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from neilfpp_method.data.cameras.camera import check_camera
from neilfpp_method.data.cameras.lens import Lens
from neilfpp_method.data.cameras.projection import camera_rays, project
from neilfpp_method.data.capture import load_capture
from neilfpp_method.errors import UserError
from neilfpp_method.relight.cameras import rays_through, resized, turntable, view_shots
from tests.data.make_capture import make_capture


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return load_capture(make_capture(tmp_path_factory.mktemp("capture") / "sphere"))


def middles(width: int, height: int) -> torch.Tensor:
    row, column = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    return torch.stack((column, row), -1).reshape(-1, 2) + 0.5


@pytest.mark.parametrize("lens", [None, Lens("OPENCV", (0.05, -0.01, 0.002, 0.001))])
def test_rays_through_pixels_agree_with_the_capture(capture, lens):
    camera = dataclasses.replace(capture.views[0].camera, lens=lens)
    found = rays_through(camera, middles(camera.width, camera.height))
    rays = found.rays
    expected = camera_rays(camera)
    assert found.valid.all()
    assert rays.origins.numpy() == pytest.approx(expected.origins.numpy(), abs=1e-5)
    assert rays.directions.numpy() == pytest.approx(expected.directions.numpy(), abs=1e-6)


def test_points_between_pixels_project_back(capture):
    camera = capture.views[1].camera
    points = torch.rand(50, 2, dtype=torch.float64) * torch.tensor([camera.width, camera.height])
    rays = rays_through(camera, points).rays
    seen = project(camera, (rays.origins + 2.5 * rays.directions).double())
    assert seen.pixel.numpy() == pytest.approx(points.numpy(), abs=1e-3)


def test_another_size_shows_the_same_scene(capture):
    camera = capture.views[0].camera
    double = resized(camera, 2.0)
    assert (double.width, double.height) == (48, 36)
    corners = torch.tensor([[0.0, 0.0], [24.0, 18.0], [7.0, 3.0]])
    one, two = rays_through(camera, corners).rays, rays_through(double, 2 * corners).rays
    assert one.directions.numpy() == pytest.approx(two.directions.numpy(), abs=1e-6)
    for factor in (0.01, 1000.0):
        with pytest.raises(UserError, match="pixels"):
            resized(camera, factor)


def test_views_keep_their_size_up_to_a_width(capture):
    shots = view_shots(capture, capture.test_views, None, None)
    assert [(shot.name, shot.camera.width, shot.view is capture.views[0]) for shot in shots] == [
        ("000", 24, True)
    ]
    assert view_shots(capture, capture.test_views, 0.5, None)[0].camera.height == 9
    assert view_shots(capture, capture.test_views, None, 48)[0].view is None
    large = dataclasses.replace(capture.views[0].camera, width=2400, height=1800)
    photographs = (dataclasses.replace(capture.views[0], camera=large),)
    assert view_shots(capture, photographs, None, None)[0].camera.width == 800
    assert view_shots(capture, photographs, 1.0, None)[0].camera.width == 2400
    with pytest.raises(UserError, match="no such views"):
        view_shots(capture, (), None, None)


def test_a_turntable_is_a_circle_around_the_center(capture):
    shots = turntable(capture, 8, None, None)
    assert [shot.name for shot in shots][:2] == ["turn_0000", "turn_0001"]
    eyes = np.stack([shot.camera.c2w[:, 3] for shot in shots])
    distances = [np.linalg.norm(capture.scene_camera(v).c2w[:, 3]) for v in capture.views]
    np.testing.assert_allclose(np.linalg.norm(eyes, axis=1), np.median(distances))
    azimuth = np.unwrap(np.arctan2(eyes[:, 1], eyes[:, 0]))
    np.testing.assert_allclose(np.diff(azimuth), 2 * np.pi / 8)
    np.testing.assert_allclose(eyes[:, 2], eyes[0, 2])
    for shot in shots:
        check_camera(shot.camera, shot.name)
        seen = project(shot.camera, torch.zeros(1, 3, dtype=torch.float64))
        np.testing.assert_allclose(seen.pixel[0], [shot.camera.width / 2, shot.camera.height / 2])
        above = project(shot.camera, torch.tensor([[0.0, 0.0, 0.1]], dtype=torch.float64))
        assert above.pixel[0, 1] < seen.pixel[0, 1]
        assert above.pixel[0, 0] == pytest.approx(seen.pixel[0, 0])
    with pytest.raises(UserError, match="1 frames"):
        turntable(capture, 1, None, None)
