"""The visual hull of a sphere's silhouettes compared with the sphere, and silhouettes without a hull."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from neilfpp_method.data.cameras.camera import Camera
from neilfpp_method.data.files.images import write_png
from neilfpp_method.data.hulls.silhouettes import Outline, agreement, read_outlines, sightings
from neilfpp_method.data.hulls.visual_hull import DistanceCube, find_hull, signed_distance, visual_hull
from neilfpp_method.data.views import View

BALL = 0.6
SIZE = 120
CELL = 2 * 1.3 / 96


def camera_at(eye: Sequence[float], focal: float = 1.5 * SIZE, size: int = SIZE) -> Camera:
    """A camera that looks at the origin."""
    eye = np.asarray(eye, float)
    forward = -eye / np.linalg.norm(eye)
    right = np.cross(forward, [0.1, 0.2, 1.0])
    right /= np.linalg.norm(right)
    w2c = np.eye(4)
    w2c[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    w2c[:3, 3] = -w2c[:3, :3] @ eye
    return Camera(focal, focal, size / 2, size / 2, size, size, w2c)


def disc(camera: Camera, center: Sequence[float] = (0.0, 0.0, 0.0), radius: float = BALL) -> np.ndarray:
    """The silhouette of a ball, from the angle between the rays and the direction to its centre, without the
    package's projection.
    """
    rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
    local = np.stack(
        [(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, np.ones_like(rows)], axis=-1
    )
    rays = local @ camera.w2c[:3, :3] / np.linalg.norm(local, axis=-1, keepdims=True)
    to = np.asarray(center) - camera.c2w[:, 3]
    distance = np.linalg.norm(to)
    return rays @ to / distance > np.sqrt(1 - (radius / distance) ** 2)


def ring(count: int, distance: float = 4.0, **camera) -> list[Outline]:
    """Silhouettes of the ball from directions that are evenly distributed over the sphere."""
    k = np.arange(count) + 0.5
    z, azimuth = 1 - 2 * k / count, k * np.pi * (3 - np.sqrt(5))
    eyes = distance * np.stack(
        [np.sqrt(1 - z**2) * np.cos(azimuth), np.sqrt(1 - z**2) * np.sin(azimuth), z], axis=1
    )
    cameras = [camera_at(eye, **camera) for eye in eyes]
    return [Outline(View(f"{i}", i, c, Path()), disc(c)) for i, c in enumerate(cameras)]


def random_points(count: int, reach: float) -> torch.Tensor:
    return reach * (2 * torch.rand(count, 3, generator=torch.Generator().manual_seed(0)) - 1)


@pytest.fixture(scope="module")
def hull() -> DistanceCube:
    found = find_hull(ring(40))
    assert isinstance(found, DistanceCube)
    return found


def test_the_hull_of_a_ball_is_the_ball(hull):
    x = random_points(4000, 1.2)
    truth = x.norm(dim=-1) - BALL
    found = hull.at(x)
    clear = truth.abs() > 1.5 * CELL
    assert torch.equal(found[clear] < 0, truth[clear] < 0)
    # A hull contains the body, up to one cell; that of 40 views is only slightly larger than the ball.
    assert (found - truth).abs().mean() < CELL
    assert (found - truth).max() < 1.5 * CELL


def test_the_distance_is_extended_outside_the_cube(hull):
    far = torch.tensor([[3.0, 0.0, 0.0], [0.0, -2.0, 0.0]])
    assert hull.at(far).tolist() == pytest.approx([3.0 - BALL, 2.0 - BALL], abs=2 * CELL)


def test_a_few_wrong_masks_have_no_influence_and_many_do():
    outlines = ring(40)
    broken = [replace(outline, inside=np.roll(outline.inside, SIZE // 2, axis=1)) for outline in outlines]
    whole = visual_hull(outlines, 1.3, 32)
    two = visual_hull([*broken[:2], *outlines[2:]], 1.3, 32)
    assert (two & whole).sum() > 0.95 * whole.sum(), (
        "two of forty may err; at the rim a third is off by a pixel"
    )
    assert (two & ~whole).sum() == 0
    assert (
        find_hull([*broken[:20], *outlines[20:]], resolution=32)
        == "the masks have almost no region in common"
    )


def test_views_that_do_not_contain_a_point_are_ignored_there():
    # Half of the views are close-ups, whose images lie within the ball and are white everywhere.
    close = ring(20, focal=6.0 * SIZE)
    assert not any(outline.complete for outline in close)
    hull = find_hull([*ring(20), *close], resolution=32)
    x = random_points(2000, 1.1)
    truth = x.norm(dim=-1) - BALL
    assert (hull.at(x) - truth).abs().mean() < 2 * CELL
    # With only close-ups, no view shows the outline of the ball or the space outside the images.
    alone = visual_hull(close, 1.3, 32)
    center = (np.arange(32) + 0.5) * 2.6 / 32 - 1.3
    assert (
        np.linalg.norm(np.stack(np.meshgrid(center, center, center, indexing="ij"), -1)[alone], axis=-1).max()
        < 1.3
    )


def test_a_hole_that_is_visible_in_views_is_open():
    # A bore along z, which is visible in the six views near that axis.
    along = [camera_at([0.2 * np.cos(a), 0.2 * np.sin(a), 4.0]) for a in np.arange(6.0)]
    bored = [Outline(View("bore", 0, c, Path()), disc(c) & ~disc(c, radius=0.2)) for c in along]
    hull = find_hull([*ring(30), *bored], resolution=48)
    assert hull.at(torch.zeros(1, 3)) > 0
    assert (hull.at(torch.tensor([[0.4, 0.0, 0.0], [0.0, -0.4, 0.0]])) < -0.05).all()


def rod(camera: Camera, end: Sequence[float], radius: float) -> np.ndarray:
    """The silhouette of a thin rod from −end to end: what lies within its projected radius of its axis."""
    axis = np.linspace(-1, 1, 2000)[:, None] * np.asarray(end)
    local = axis @ camera.w2c[:3, :3].T + camera.w2c[:3, 3]
    pixel = local[:, :2] / local[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
    centers = np.stack([columns.ravel(), rows.ravel()], axis=1)
    offset, nearest = cKDTree(pixel).query(centers)
    inside = offset < camera.fx * radius / local[nearest, 2]
    return inside.reshape(rows.shape)


def test_a_rod_of_three_cells_belongs_to_the_hull_along_its_whole_length():
    end, radius = [0.1, 0.3, 0.9], 0.02
    outlines = [replace(o, inside=rod(o.view.camera, end, radius)) for o in ring(24, size=360, focal=540.0)]
    hull = find_hull(outlines)
    assert isinstance(hull, DistanceCube)
    along = torch.linspace(-0.95, 0.95, 200)[:, None] * torch.tensor(end)
    assert (hull.at(along) < 0).float().mean() > 0.9
    beside = along + 0.06 * torch.tensor([0.9487, -0.3162, 0.0])
    assert (hull.at(beside) > 0.02).all()


def test_a_ball_is_counted_wherever_one_of_its_points_is():
    outlines = [replace(o, inside=rod(o.view.camera, [0.1, 0.3, 0.9], 0.02)) for o in ring(6)]
    # The image of a close-up ends within the rod: beside it, the view knows nothing.
    outlines += [
        replace(o, inside=rod(o.view.camera, [0.1, 0.3, 0.9], 0.02)) for o in ring(6, focal=5.0 * SIZE)
    ]
    assert not outlines[-1].complete
    centers, reach = random_points(400, 1.2).double().numpy(), 0.1
    inner = reach * torch.nn.functional.normalize(random_points(400, 1.0).double(), dim=-1).numpy()
    for outline in outlines:
        ball = sightings([outline], centers, reach)
        for share in (0.0, 0.5, 0.99):
            point = sightings([outline], centers + share * inner)
            assert (ball.inside >= point.inside)[ball.visible_in == 1].all()
            assert (point.visible_in >= ball.visible_in).all()
    far = sightings(outlines[:1], np.array([[0.9, 0.0, 0.0], [0.0, 0.0, 9.0]]), reach)
    assert far.inside.tolist() == [0, 0]


def test_masks_without_a_hull_are_reported():
    outlines = ring(10)
    white = [replace(outline, inside=np.ones_like(outline.inside)) for outline in outlines]
    assert find_hull(white, resolution=32) == "the masks show something that extends beyond the scene box"
    black = [replace(outline, inside=np.zeros_like(outline.inside)) for outline in outlines]
    assert find_hull(black, resolution=32) == "the masks have almost no region in common"


def test_stray_pixels_of_masks_do_not_prevent_a_hull():
    def with_ball(outline: Outline, center: Sequence[float], radius: float) -> Outline:
        return replace(outline, inside=outline.inside | disc(outline.view.camera, center, radius))

    edge = [1.28, 0.1, 0.0]
    stray = [with_ball(outline, edge, 0.03) for outline in ring(40)]
    assert visual_hull(stray, 1.3, 96)[-1].any()
    hull = find_hull(stray, resolution=96)
    assert not isinstance(hull, str)
    assert hull.at(torch.tensor([[0.0, 0.0, 0.0]])) < -0.5
    assert hull.at(torch.tensor([edge])) > 0
    large = [with_ball(outline, edge, 0.2) for outline in ring(40)]
    assert find_hull(large, resolution=96) == "the masks show something that extends beyond the scene box"


def test_the_signed_distance_of_a_slab():
    inside = np.zeros((20, 20, 20), bool)
    inside[:10] = True
    distance = signed_distance(inside, 0.1)
    # The surface lies between the centres of rows 9 and 10; far from the ends the blur changes nothing.
    assert distance[5:15, 10, 10] == pytest.approx(0.1 * (np.arange(5, 15) - 9.5), abs=1e-3)


def test_agreement_is_a_share_of_the_views_that_contain_the_point():
    outlines = ring(8)
    points = np.array([[0.0, 0.0, 0.0], [5.0, 5.0, 5.0]])
    found = sightings(outlines, points)
    assert found.visible_in.tolist() == [8, 8]
    assert found.inside.tolist() == [8, 0]
    assert agreement(outlines, points).tolist() == [1.0, 0.0]


def test_large_masks_are_read_small_with_cameras_to_match(tmp_path):
    camera = camera_at([0.0, 0.0, 4.0], focal=1.5 * 400, size=400)
    mask = disc(camera, center=(0.2, 0.1, 0.0))
    write_png(tmp_path / "mask.png", np.where(mask, 255, 0).astype(np.uint8))
    view = View("0", 0, camera, tmp_path / "image.png", tmp_path / "mask.png")
    (outline,) = read_outlines([view], max_side=100)
    assert outline.inside.shape == (100, 100)
    assert outline.inside.mean() == pytest.approx(mask.mean(), rel=0.02)
    assert sightings(
        [outline], np.array([[0.2, 0.1, 0.0], [0.2, 0.1 + BALL + 0.1, 0.0]])
    ).inside.tolist() == [1, 0]
