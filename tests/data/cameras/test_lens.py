"""Lenses compared with the libraries that define them: pycolmap for every model, OpenCV for its own
models.
"""

from __future__ import annotations

import cv2
import numpy as np
import pycolmap
import pytest
import torch

from neilfpp_method.data.cameras.camera import Camera, check_camera
from neilfpp_method.data.cameras.lens import LENSES, Lens, lens_of
from neilfpp_method.data.cameras.projection import CameraRays, camera_rays, project
from neilfpp_method.data.cameras.undistort import resample, straight_camera
from neilfpp_method.errors import UserError
from tests.data.make_capture import CENTER, camera_pose

# Typical coefficients of a calibration, by model.
COEFFICIENTS = {
    "SIMPLE_RADIAL": [-0.12],
    "RADIAL": [-0.12, 0.03],
    "OPENCV": [-0.12, 0.03, 0.002, -0.001],
    "FULL_OPENCV": [-0.12, 0.03, 0.002, -0.001, 0.01, 0.02, -0.01, 0.004],
    "SIMPLE_RADIAL_FISHEYE": [0.03],
    "RADIAL_FISHEYE": [0.03, -0.005],
    "OPENCV_FISHEYE": [0.03, -0.005, 0.002, -0.001],
    "THIN_PRISM_FISHEYE": [0.03, -0.005, 0.001, -0.001, 0.001, 0.0, 0.001, -0.001],
    "RAD_TAN_THIN_PRISM_FISHEYE": [
        0.03,
        -0.005,
        0.001,
        0.0,
        0.0,
        0.0,
        0.001,
        -0.001,
        0.001,
        0.0,
        -0.001,
        0.0,
    ],
    "FOV": [0.6],
    "SIMPLE_DIVISION": [-0.1],
    "DIVISION": [-0.1],
    "SIMPLE_FISHEYE": [],
    "FISHEYE": [],
    "EUCM": [0.55, 1.05],
}
FOCAL, CENTER_PIXEL, SIZE = (52.0, 52.0), (41.5, 28.0), (80, 60)


def camera(model: str, focal: tuple[float, float] = FOCAL) -> Camera:
    return Camera(*focal, *CENTER_PIXEL, *SIZE, camera_pose(1, 6), Lens(model, tuple(COEFFICIENTS[model])))


def seen_points(count: int = 200) -> np.ndarray:
    """Points around the scene's centre, at which the camera of `camera_pose` looks."""
    return CENTER + np.random.default_rng(3).uniform(-1.5, 1.5, (count, 3))


def local(points: np.ndarray) -> np.ndarray:
    w2c = camera_pose(1, 6)
    return points @ w2c[:3, :3].T + w2c[:3, 3]


def test_every_model_of_the_library_is_supported() -> None:
    assert set(COEFFICIENTS) >= set(LENSES)


@pytest.mark.parametrize("model", LENSES)
def test_projection_is_that_of_pycolmap(model: str) -> None:
    names = pycolmap.Camera.create_from_model_name(0, model, 1.0, 1, 1).params_info.split(", ")
    focal = [FOCAL[0]] if names[0] == "f" else list(FOCAL)
    oracle = pycolmap.Camera(
        model=model, width=SIZE[0], height=SIZE[1], params=[*focal, *CENTER_PIXEL, *COEFFICIENTS[model]]
    )
    points = seen_points()
    seen = project(camera(model), torch.from_numpy(points))
    assert np.abs(seen.pixel.numpy() - oracle.img_from_cam(local(points))).max() < 1e-6
    assert np.abs(seen.depth.numpy() - local(points)[:, 2]).max() < 1e-9


@pytest.mark.parametrize("model", ["SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE"])
def test_projection_is_that_of_opencv(model: str) -> None:
    focal = (52.0, 55.0)  # two focal lengths; the simple models take them as well
    k = np.array([[focal[0], 0, CENTER_PIXEL[0]], [0, focal[1], CENTER_PIXEL[1]], [0, 0, 1]])
    points, zero = local(seen_points())[:, None], np.zeros(3)
    coefficients = np.array(COEFFICIENTS[model])
    if model == "OPENCV_FISHEYE":
        expected = cv2.fisheye.projectPoints(points, zero, zero, k, coefficients)[0]
    else:
        padded = np.pad(coefficients, (0, max(4 - len(coefficients), 0)))
        expected = cv2.projectPoints(points, zero, zero, k, padded)[0]
    seen = project(camera(model, focal), torch.from_numpy(seen_points()))
    assert np.abs(seen.pixel.numpy() - expected[:, 0]).max() < 1e-6


@pytest.mark.parametrize("model", LENSES)
def test_rays_project_back_to_pixel_centers(model: str) -> None:
    rays = camera_rays(camera(model))
    assert torch.allclose(rays.directions.norm(dim=-1), torch.ones(()), atol=1e-5)
    seen = project(camera(model), (rays.origins + 3.0 * rays.directions).double())
    rows, columns = np.mgrid[: SIZE[1], : SIZE[0]]
    expected = np.stack([columns.ravel() + 0.5, rows.ravel() + 0.5], axis=1)
    assert np.abs(seen.pixel.numpy() - expected).max() < 0.01


def test_rays_of_many_cameras_are_not_confused() -> None:
    lens, other = camera("OPENCV"), camera("OPENCV_FISHEYE")
    moved = Camera(*FOCAL, *CENTER_PIXEL, *SIZE, camera_pose(4, 6), lens.lens)
    pinhole = Camera(*FOCAL, *CENTER_PIXEL, 30, 20, camera_pose(2, 6))
    cameras = [pinhole, lens, other, moved]
    rays = CameraRays(cameras)
    number = torch.tensor([3, 0, 2, 1, 1, 3, 0])
    pixel = torch.tensor([0, 599, 4799, 81, 4000, 4799, 31])
    together = rays(number, pixel)
    for i, (n, p) in enumerate(zip(number.tolist(), pixel.tolist(), strict=True)):
        alone = camera_rays(cameras[n])
        assert torch.allclose(together.directions[i], alone.directions[p], atol=1e-6)
        assert torch.allclose(together.origins[i], alone.origins[p])


def test_a_lens_without_distortion_is_a_pinhole() -> None:
    assert lens_of("PINHOLE", []) is None
    assert lens_of("OPENCV", [0.0] * 4) is None
    assert lens_of("OPENCV_FISHEYE", [0.0] * 4) is not None  # the angle, not its tangent, is the radius


@pytest.mark.parametrize(
    ("lens", "words"),
    [
        (Lens("WAVY", (1.0,)), "unknown lens model 'WAVY'"),
        (Lens("PINHOLE", ()), "unknown lens model 'PINHOLE'"),
        (Lens("OPENCV", (0.1,)), "the lens OPENCV has 4 finite coefficients"),
        (Lens("RADIAL", (0.1, float("nan"))), "the lens RADIAL has 2 finite coefficients"),
    ],
)
def test_bad_lenses_are_refused(lens: Lens, words: str) -> None:
    with pytest.raises(UserError, match="view 7.*" + words):
        check_camera(Camera(*FOCAL, *CENTER_PIXEL, *SIZE, camera_pose(1, 6), lens), "view 7")


def barrel(strength: float) -> Camera:
    """A lens with x·(1 − s x²), which decreases beyond x = 1/√(3 s). Its maximum is 2/3 of that x, and no ray
    reaches pixels beyond it.
    """
    return Camera(*FOCAL, *CENTER_PIXEL, *SIZE, camera_pose(1, 6), Lens("RADIAL", (-strength, 0.0)))


def test_a_lens_that_shows_nothing_at_most_pixels_is_refused() -> None:
    with pytest.raises(UserError, match=r"RADIAL shows nothing at .* of its 4800 pixels"):
        camera_rays(barrel(0.8))


def test_pixels_at_which_a_lens_shows_nothing_are_marked_and_point_away() -> None:
    seen_by = barrel(0.3)
    pinhole = Camera(*FOCAL, *CENTER_PIXEL, 30, 20, camera_pose(2, 6))
    rays = CameraRays([pinhole, seen_by])
    assert rays.has_ray(0).shape == (600,)
    assert rays.has_ray(0).all()
    rows, columns = np.mgrid[: SIZE[1], : SIZE[0]]
    radius = (
        np.hypot(columns.ravel() + 0.5 - CENTER_PIXEL[0], rows.ravel() + 0.5 - CENTER_PIXEL[1]) / FOCAL[0]
    )
    edge = 2 / 3 / np.sqrt(3 * 0.3)
    with_ray = rays.has_ray(1).numpy()
    assert with_ray[radius < edge - 0.01].all()
    assert not with_ray[radius > edge + 0.01].any()
    assert 0.1 < 1 - with_ray.mean() < 0.3
    directions = camera_rays(seen_by).directions.numpy()
    axis = seen_by.w2c[2, :3]
    assert np.allclose(directions[~with_ray], -axis, atol=1e-6)
    assert (directions[with_ray] @ axis > 0).all()


@pytest.mark.parametrize("model", ["OPENCV", "OPENCV_FISHEYE"])
def test_a_resampled_image_is_that_of_the_pinhole(model: str) -> None:
    bent = camera(model)
    straight = straight_camera(bent)
    assert straight.lens is None
    assert straight_camera(straight) is straight

    def picture(seen_by: Camera) -> np.ndarray:
        """An image at infinity, smooth in the direction of view."""
        directions = camera_rays(seen_by).directions.numpy()
        return np.sin(4 * directions + 0.3).reshape(seen_by.height, seen_by.width, 3).astype(np.float32)

    moved = resample(picture(bent), bent, straight)
    difference = np.abs(moved - picture(straight))
    assert difference[1:-1, 1:-1].max() < 0.01  # bilinear; half a pixel off would be 0.03
