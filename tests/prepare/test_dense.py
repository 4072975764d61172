"""Stereo compared with depths, planes and normals in closed form."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from neilfpp_method.data.cameras.camera import Camera
from neilfpp_method.data.cameras.neighbors import choose_sources
from neilfpp_method.data.pixels.gray import GrayView
from neilfpp_method.data.views import Normalization
from neilfpp_method.prepare.depth_fusion import DepthMap, fuse_depth_maps
from neilfpp_method.prepare.depth_planes import fit_planes
from neilfpp_method.prepare.plane_sweep import inverse_depth_step, sweep
from tests.prepare.textured_corner import FOCAL, photograph, pose

SIZE = (240, 180)
BOX = Normalization(0.8, (0.4, 0.4, 0.4))


def camera(w2c: np.ndarray, size: tuple[int, int] = SIZE) -> Camera:
    focal = FOCAL * size[0]
    return Camera(focal, focal, size[0] / 2, size[1] / 2, *size, w2c)


def rays(view: Camera) -> np.ndarray:
    """Directions of unit depth in the world frame."""
    rows, columns = np.mgrid[: view.height, : view.width] + 0.5
    local = np.stack([(columns - view.cx) / view.fx, (rows - view.cy) / view.fy, np.ones_like(rows)], axis=-1)
    return local @ view.w2c[:3, :3]


def plane_depth(view: Camera, normal: np.ndarray, offset: float) -> np.ndarray:
    """The depth at which each pixel's ray hits the plane normal · x = offset."""
    eye = view.c2w[:, 3]
    return ((offset - eye @ normal) / (rays(view) @ normal)).astype(np.float32)


def corner_depth(view: Camera) -> np.ndarray:
    depths = np.stack([plane_depth(view, axis, 0.0) for axis in np.eye(3)])
    return np.where(depths > 0, depths, np.inf).min(axis=0)


def picture(i: int) -> np.ndarray:
    """A grey image, computed at three times the size and averaged, because the noise is finer than a
    pixel.
    """
    fine = photograph(pose(i, 9), (3 * SIZE[0], 3 * SIZE[1])).mean(axis=2)
    return cv2.resize(fine, SIZE, interpolation=cv2.INTER_AREA)


def test_the_sweep_finds_the_depth_of_the_corner():
    views = [GrayView(camera(pose(i, 9)), picture(i)) for i in range(9)]
    sources = choose_sources([view.camera for view in views], np.array(BOX.center), 4)[4]
    depth = sweep(views[4], [views[j] for j in sources], BOX)
    known = depth > 0
    assert known.mean() > 0.9
    inverse = np.abs(1 / depth[known] - 1 / corner_depth(views[4].camera)[known])
    pixel = inverse_depth_step(views[4].camera, [views[j].camera for j in sources])
    assert np.median(inverse) < 0.2 * pixel
    assert np.quantile(inverse, 0.9) < 0.5 * pixel


def test_without_neighbors_or_texture_depth_is_unknown():
    views = [GrayView(camera(pose(i, 9)), np.full(SIZE[::-1], 0.5, np.float32)) for i in range(3)]
    assert not sweep(views[0], [], BOX).any()
    assert not sweep(views[0], views[1:], BOX).any()


def test_a_camera_that_looks_away_from_the_scene_has_no_depths():
    """The images match with a disparity of 20 pixels, which is that of an inverse depth of −2.5."""
    noise = np.random.default_rng(0).random((SIZE[1], SIZE[0] + 40)).astype(np.float32)
    noise = cv2.GaussianBlur(noise, (0, 0), 3)
    noise = (noise - noise.min()) / (noise.max() - noise.min())
    beside = np.eye(4)
    beside[0, 3] = -8 / (FOCAL * SIZE[0])
    reference = GrayView(camera(np.eye(4)), np.ascontiguousarray(noise[:, 30:270]))
    source = GrayView(camera(beside), np.ascontiguousarray(noise[:, 10:250]))
    assert (sweep(reference, [source], Normalization(0.8, (0.0, 0.0, -1.6))) == 0).all()


def test_sources_are_neither_too_close_nor_too_far():
    cameras = [camera(pose(i, 13, arc=240)) for i in range(13)]
    chosen = choose_sources([*cameras, cameras[6]], np.array(BOX.center), 3)
    assert 13 not in chosen[6]
    assert set(chosen[6]) <= {4, 5, 7, 8}
    assert chosen[0]


@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (0.3, 0.2, 0.93), (-0.5, 0.3, 0.81)])
def test_the_fit_of_a_plane_is_exact(normal):
    view = camera(pose(2, 9))
    normal = np.array(normal) / np.linalg.norm(normal)
    depth = plane_depth(view, normal, 0.1)
    fitted = fit_planes(view, np.where(depth > 0, depth, 0.0), step=0.01)
    inner = np.zeros(depth.shape, bool)
    inner[10:-10, 10:-10] = True
    inner &= fitted.depth > 0
    assert inner.sum() > 10_000
    np.testing.assert_allclose(fitted.depth[inner], depth[inner], rtol=1e-4)
    np.testing.assert_allclose(fitted.normal[inner], np.broadcast_to(normal, (inner.sum(), 3)), atol=1e-3)


def test_noise_gives_no_plane():
    view = camera(pose(2, 9))
    depth = 1.5 + np.random.default_rng(0).random(SIZE[::-1]).astype(np.float32)
    assert not fit_planes(view, depth, step=0.005).depth.any()


def test_depths_that_views_agree_on_are_fused_once():
    cameras = [camera(pose(i, 7)) for i in range(7)]
    depths = [corner_depth(view).astype(np.float32) for view in cameras]
    rng = np.random.default_rng(1)
    liar = rng.random(depths[3].shape) < 0.02
    depths[3] = np.where(liar, depths[3] * 0.8, depths[3]).astype(np.float32)
    neighbors = [[j for j in range(7) if j != i] for i in range(7)]
    maps = [DepthMap(cameras[i], depths[i], 0.01, neighbors[i]) for i in range(7)]
    points = fuse_depth_maps(maps, lambda: None)
    assert 20_000 < len(points.position) < sum(depth.size for depth in depths) / 2
    distance = np.abs(points.position)
    assert np.median(distance.min(axis=1)) < 1e-3
    # The planes round off the creases by less than a step of inverse depth, here 0.01 at a depth of 1.6.
    assert np.quantile(distance.min(axis=1), 0.99) < 0.01 * 1.6**2
    facing = np.take_along_axis(points.normal, distance.argmin(axis=1)[:, None], axis=1)
    assert np.median(facing) > 0.999
