"""Patches of a textured plane, whose images are computed in closed form, are compared between views."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch.nn.functional import normalize

from neilfpp_method.data.cameras.camera import Camera
from neilfpp_method.fields.sdf import SdfSample
from neilfpp_method.hosts import patches
from neilfpp_method.hosts.patches import PatchViews, patch_loss
from neilfpp_method.structures import PixelBatch, SurfaceHits
from tests.data.hulls.test_visual_hull import camera_at

SIZE = 160
EYES = ((0.0, -0.6, 2.0), (0.4, -0.4, 2.0), (-0.4, -0.3, 2.0), (0.0, 0.1, 2.0), (0.3, 0.3, 2.0))
UP = torch.tensor([[0.0, 0.0, 1.0]])


def texture(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Grey values of the plane z = 0, with waves of 10 to 30 pixels in all directions."""
    waves = ((11.0, 3.0), (-4.0, 13.0), (19.0, 17.0), (8.0, -21.0))
    return 0.5 + sum(0.1 * np.sin(u * x + v * y + u) for u, v in waves)


def image(camera: Camera, gray=texture) -> np.ndarray:
    """The plane as a camera sees it."""
    rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
    local = np.stack(
        [(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, np.ones_like(rows)], -1
    )
    rays, eye = local @ camera.w2c[:3, :3], camera.c2w[:3, 3]
    points = eye - eye[2] / rays[..., 2:] * rays
    return gray(points[..., 0], points[..., 1]).astype(np.float32)


CAMERAS = [camera_at(eye, focal=1.2 * SIZE, size=SIZE) for eye in EYES]


def views(gray=texture) -> PatchViews:
    return PatchViews([image(camera, gray) for camera in CAMERAS], CAMERAS)


def points(count: int = 40) -> torch.Tensor:
    """Points of the plane around the centre."""
    torch.manual_seed(0)
    return torch.nn.functional.pad(0.5 * torch.rand(count, 2) - 0.25, (0, 1))


def disagreement(compared: PatchViews, position: torch.Tensor, normal: torch.Tensor) -> torch.Tensor:
    """The disagreement with the same views at every call."""
    torch.manual_seed(1)
    return compared.disagreement(position, normal, torch.zeros(len(position), dtype=torch.long))


def test_only_the_true_plane_agrees():
    compared, x = views(), points()
    up = UP.expand_as(x)
    right = disagreement(compared, x, up)
    assert right.max() < 0.01
    for height in (-0.03, 0.03):
        assert disagreement(compared, x + height * up, up).mean() > 20 * right.mean()
    tilted = normalize(up + torch.tensor([0.0, 0.4, 0.0]), dim=-1)
    assert disagreement(compared, x, tilted).mean() > 3 * right.mean()


def test_the_gradient_is_that_of_finite_differences():
    """Along the rays to the points, which keeps their pixels, and along a tilt of the normals."""
    compared, x = views(), points()
    tilt, rays = torch.tensor([0.2, -0.1, 0.0]), rays_to(x).directions

    def mean(nearer: torch.Tensor, share: torch.Tensor) -> torch.Tensor:
        return disagreement(
            compared, x - nearer * rays, normalize(UP + share * tilt, dim=-1).expand_as(x)
        ).mean()

    at = [torch.tensor(value, requires_grad=True) for value in (0.012, 0.5)]
    gradients = torch.autograd.grad(mean(*at), at)
    for i, (gradient, step) in enumerate(zip(gradients, (1e-3, 1e-2), strict=True)):
        ends = [mean(*(v.detach() + sign * step * (j == i) for j, v in enumerate(at))) for sign in (-1, 1)]
        assert gradient.item() == pytest.approx((ends[1] - ends[0]).item() / (2 * step), rel=0.05)
    assert gradients[0] > 0, "descent moves the points towards the plane"


def test_exposure_and_offset_do_not_matter():
    gains = iter((1.0, 0.6, 0.8, 0.5, 0.9))
    images = [gain * image(camera) + 0.05 for gain, camera in zip(gains, CAMERAS, strict=True)]
    x = points()
    assert disagreement(PatchViews(images, CAMERAS), x, UP.expand_as(x)).max() < 0.01


@pytest.mark.parametrize("case", ["no texture", "from behind", "outside of the images", "grazing"])
def test_nothing_is_compared(case):
    x = points()
    off, normal = x + 0.03 * UP, UP.expand_as(x)
    compared = views((lambda x, y: 0.5 + 0.001 * np.sin(20 * x)) if case == "no texture" else texture)
    if case == "from behind":
        normal = -normal
    elif case == "outside of the images":
        off = off + torch.tensor([5.0, 0.0, 0.0])
    elif case == "grazing":
        normal = normalize(torch.tensor([[0.0, 1.0, 0.02]]), dim=-1).expand_as(x)
    off, normal = off.requires_grad_(), normal.clone().requires_grad_()
    error = disagreement(compared, off, normal)
    assert not error.any()
    for gradient in torch.autograd.grad(error.sum(), (off, normal)):
        assert not gradient.any()


def test_the_best_views_count():
    """A point that is hidden in two of five views is compared with the others."""
    images = [image(camera) for camera in CAMERAS]
    noise = np.random.default_rng(0).random((SIZE, SIZE), np.float32)
    x = points()
    hidden = PatchViews([*images[:3], noise, noise], CAMERAS)
    assert disagreement(hidden, x, UP.expand_as(x)).max() < 0.01


def test_views_that_are_far_apart_are_not_compared():
    far = [camera_at(eye) for eye in ((0.0, 0.0, 3.0), (3.0, 0.0, 0.1))]
    assert not PatchViews([np.zeros((camera.height, camera.width)) for camera in far], far).any
    assert views().any


def test_other_poses_are_used():
    compared, x = views(), points()
    compared.pose(CAMERAS[::-1])
    assert disagreement(compared, x, UP.expand_as(x)).mean() > 0.1


def rays_to(x: torch.Tensor) -> PixelBatch:
    eye = torch.tensor([EYES[0]]).expand_as(x)
    zeros = torch.zeros(len(x))
    return PixelBatch(
        origins=eye,
        directions=normalize(x - eye, dim=-1),
        color=torch.zeros_like(x),
        mask=torch.ones_like(zeros),
        mask_known=torch.ones_like(zeros),
        image_gradient=zeros,
        view=torch.zeros(len(x), dtype=torch.long),
    )


@pytest.mark.parametrize("slope", [1.0, 0.7])
def test_descent_finds_the_plane(slope):
    """G is `slope` times the height above z = h. Its h is found, from two hundredths off, as are hits."""
    compared, x = views(), points(60)
    height = torch.tensor(0.02, requires_grad=True)

    def field(p: torch.Tensor) -> SdfSample:
        return SdfSample(slope * (p[:, 2] - height), slope * UP.expand_as(p), torch.zeros(len(p), 0))

    ones = torch.ones(len(x))
    optimizer = torch.optim.Adam([height], lr=1e-3)
    for _ in range(60):
        batch = rays_to(x)
        along = (height.detach() + 0.003 - batch.origins[:, 2:]) / batch.directions[:, 2:]
        hits = SurfaceHits(
            color=torch.zeros_like(x),
            position=batch.origins + along * batch.directions,
            normal=UP.expand_as(x),
            opacity=ones,
            concentration=ones,
        )
        optimizer.zero_grad()
        patch_loss(compared, field, hits, batch, 0.8).mean().backward()
        optimizer.step()
    assert abs(height.item()) < 1e-3


def test_rays_off_the_object_and_blended_hits_are_left_out():
    x = points(4) + torch.tensor([0.0, 0.0, 0.02])

    def field(p: torch.Tensor) -> SdfSample:
        return SdfSample(p[:, 2] - 0.02, UP.expand_as(p), torch.zeros(len(p), 0))

    ones = torch.ones(4)
    hits = SurfaceHits(
        color=torch.zeros_like(x),
        position=x + torch.tensor([[0.0], [0.0], [0.0], [2 * patches.MAX_STEP]]) * UP,
        normal=UP.expand_as(x),
        opacity=ones,
        concentration=torch.tensor([1.0, 0.5, 1.0, 1.0]),
    )
    batch = rays_to(x)
    batch.mask[2] = 0.0
    values = patch_loss(views(), field, hits, batch, 0.8).values
    assert values[0] > 0
    assert not values[1:].any()
