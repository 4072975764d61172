"""The scene box comes from the most reliable source, and wrong points have no influence."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from neilfpp_method.data.cameras.projection import project
from neilfpp_method.data.capture import load_capture
from neilfpp_method.data.files.images import read_image, write_png
from neilfpp_method.data.scene_box import FOCUS_BOX_RADIUS, box_of_cameras, box_of_points, find_box
from neilfpp_method.data.views import View
from neilfpp_method.errors import UserError
from tests.data.make_capture import CENTER, DISTANCE, RADIUS, camera_pose, make_capture


def sphere_points(count: int = 2000) -> np.ndarray:
    points = np.random.default_rng(0).normal(size=(count, 3))
    return CENTER + RADIUS * points / np.linalg.norm(points, axis=1, keepdims=True)


def views(
    root: Path, masks: bool = False, count: int = 8, size: tuple[int, int] = (64, 48)
) -> tuple[View, ...]:
    return load_capture(make_capture(root, views=count, size=size, masks=masks)).views


def test_points_define_the_box_in_spite_of_outliers() -> None:
    points = np.concatenate([sphere_points(), 900 * np.eye(3)])
    box = box_of_points(points)
    assert np.allclose(box.center, CENTER, atol=0.03 * RADIUS)
    assert RADIUS < box.scale < 1.15 * RADIUS


def test_the_visual_hull_contains_the_object_closely(tmp_path: Path) -> None:
    box = find_box(views(tmp_path, masks=True, count=16)).normalization
    assert np.allclose(box.center, CENTER, atol=0.15 * RADIUS)
    assert RADIUS < box.scale < 1.3 * RADIUS
    assert np.abs(sphere_points() - box.center).max() <= box.scale


def test_the_box_contains_parts_that_are_thinner_than_its_grid(tmp_path: Path) -> None:
    """A blob on a pole that is a pixel wide: hardly a point of a grid lies in all silhouettes of the pole."""
    masked = views(tmp_path, masks=True, count=16, size=(160, 120))
    ends = np.stack([CENTER - np.array([0, 0, 1.1 * RADIUS]), CENTER + np.array([0, 0, 1.1 * RADIUS])])
    for view in masked:
        low, high = project(view.camera, torch.from_numpy(ends)).pixel.numpy().round().astype(int).tolist()
        mask = np.zeros((120, 160), np.uint8)
        cv2.circle(mask, (80, 60), 10, 255, -1)
        cv2.line(mask, low, high, 255)
        write_png(view.mask, mask)
    box = find_box(masked).normalization
    assert np.abs(ends - box.center).max() <= box.scale
    assert box.scale < 1.3 * 1.1 * RADIUS


def test_cameras_without_points_and_masks_define_the_box(tmp_path: Path) -> None:
    # The shorter side of the image spans 1 / 1.5 of the distance.
    box = box_of_cameras(views(tmp_path))
    assert np.allclose(box.center, CENTER, atol=1e-6)
    assert box.scale == pytest.approx(DISTANCE / (2 * 1.5))


def test_the_most_reliable_source_is_used(tmp_path: Path) -> None:
    masked, plain = views(tmp_path / "masked", masks=True), views(tmp_path / "plain")
    assert find_box(plain).source == "cameras"
    assert find_box(plain, sphere_points()).source == "points"
    assert find_box(masked).source == "masks"
    assert find_box(masked, sphere_points()).source == "points"
    assert find_box(plain, sphere_points(5)).source == "cameras"


def test_a_box_beside_the_focus_of_the_cameras_is_not_used(tmp_path: Path) -> None:
    """A twentieth of the points lies on one side, behind the object; the box is still not too large."""
    plain, points = views(tmp_path), CENTER + 0.4 * (sphere_points() - CENTER)
    behind = points[:100] + np.array([2 * RADIUS, 0, 0])
    lopsided = np.concatenate([points, behind])
    assert box_of_points(lopsided).scale < FOCUS_BOX_RADIUS * DISTANCE
    box = find_box(plain, lopsided)
    assert box.source == "focus"
    assert np.allclose(box.normalization.center, CENTER, atol=0.1 * RADIUS)


def test_points_outside_the_masks_are_ignored(tmp_path: Path) -> None:
    table = CENTER + np.random.default_rng(1).uniform(-4, 4, (4000, 3)) * [1, 1, 0] - [0, 0, RADIUS]
    box = find_box(views(tmp_path, masks=True), np.concatenate([sphere_points(), table])).normalization
    assert np.allclose(box.center, CENTER, atol=0.15 * RADIUS)
    assert box.scale < 1.3 * RADIUS


def test_alpha_serves_as_mask(tmp_path: Path) -> None:
    def with_alpha(view: View) -> View:
        image = tmp_path / f"{view.name}.png"
        mask = (255 * read_image(view.mask).pixels).astype(np.uint8)
        write_png(image, np.repeat(mask, 4, axis=2))
        return replace(view, image=image, mask=None)

    masked = views(tmp_path, masks=True)
    assert find_box([with_alpha(view) for view in masked]).normalization == find_box(masked).normalization


def test_opaque_images_have_no_silhouettes(tmp_path: Path) -> None:
    def opaque(view: View) -> View:
        image = tmp_path / f"{view.name}.png"
        write_png(image, np.full((48, 64, 4), 255, np.uint8))
        return replace(view, image=image, mask=None)

    masked = views(tmp_path, masks=True, count=16)
    assert find_box([opaque(view) for view in masked]).source == "cameras"
    one = find_box([opaque(masked[0]), *masked[1:]])  # a close-up, perhaps
    assert one.source == "masks"
    assert one.normalization.scale == pytest.approx(find_box(masked).normalization.scale, rel=0.1)
    assert find_box([*map(opaque, masked[:9]), *masked[9:]]).source == "cameras"


def test_a_mask_of_nothing_has_no_influence(tmp_path: Path) -> None:
    """`neilfpp inspect` has to load the capture, or else it could not name the view."""
    masked = views(tmp_path, masks=True)
    expected = find_box([*masked[:3], *masked[4:]])
    write_png(masked[3].mask, np.zeros((48, 64), np.uint8))
    assert find_box(masked).normalization.scale == pytest.approx(expected.normalization.scale, rel=1e-6)
    for view in masked:
        write_png(view.mask, np.zeros((48, 64), np.uint8))
    assert find_box(masked).source == "cameras"


def test_a_damaged_mask_has_no_influence(tmp_path: Path) -> None:
    """`neilfpp inspect` has to load the capture, or else it could name only the first damaged file."""
    masked = views(tmp_path, masks=True)
    expected = find_box([*masked[:3], *masked[4:]])
    masked[3].mask.write_bytes(masked[3].mask.read_bytes()[:60])
    assert find_box(masked).normalization.scale == pytest.approx(expected.normalization.scale, rel=1e-6)


def test_cameras_that_look_in_one_direction_or_apart_are_refused(tmp_path: Path) -> None:
    first, second, *_ = views(tmp_path)
    with pytest.raises(UserError, match="look in one direction"):
        box_of_cameras([first, replace(second, camera=replace(second.camera, w2c=camera_pose(0, 8)))])
    turn = np.diag([-1.0, 1.0, -1.0, 1.0])
    away = [replace(v, camera=replace(v.camera, w2c=turn @ v.camera.w2c)) for v in (first, second)]
    with pytest.raises(UserError, match=r"look away.*the axes may be of another convention"):
        box_of_cameras(away)


def turned(several: tuple[View, ...], jitter: float = 0.0) -> list[View]:
    """Views of a tripod that turns about its vertical axis and is moved by `jitter` between photographs."""
    eyes = np.array([5.2, -0.2, 0.3]) + np.random.default_rng(1).normal(scale=jitter, size=(len(several), 3))
    result = []
    for i, (view, eye) in enumerate(zip(several, eyes, strict=True)):
        w2c = view.camera.w2c.copy()
        cos, sin = np.cos(0.1 * i), np.sin(0.1 * i)
        w2c[:3, :3] = np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]]) @ several[0].camera.w2c[:3, :3]
        w2c[:3, 3] = -w2c[:3, :3] @ eye
        result.append(replace(view, camera=replace(view.camera, w2c=w2c)))
    return result


def test_cameras_at_one_point_are_refused(tmp_path: Path) -> None:
    """Their axes meet at the cameras, up to rounding errors, and the box would have a size of 1e-15."""
    with pytest.raises(UserError, match="all cameras are at one point"):
        find_box(turned(views(tmp_path)))


@pytest.mark.parametrize("count", [8, 12, 20, 31])
def test_cameras_that_turn_at_one_place_are_refused(tmp_path: Path, count: int) -> None:
    """Their axes meet within millimetres of them, before some and behind others."""
    with pytest.raises(UserError, match="look away from one another, as on a tripod that turns"):
        find_box(turned(views(tmp_path, count=count), jitter=0.003))


def test_masks_without_a_common_region_are_refused(tmp_path: Path) -> None:
    some = views(tmp_path, masks=True)
    for view in some:
        corner = np.zeros((48, 64), np.uint8)
        corner[:6, :6] = 255
        write_png(view.mask, corner)
    with pytest.raises(UserError, match="lies in all masks"):
        find_box(some)
