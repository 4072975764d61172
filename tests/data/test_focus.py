"""The focus of cameras, on constructed cameras whose axes meet at known points."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from neilfpp_method.data.cameras.camera import Camera
from neilfpp_method.data.files.images import write_png
from neilfpp_method.data.focus import find_focus
from neilfpp_method.data.scene_box import FOCUS_BOX_RADIUS, box_of_focus, box_of_points, find_box
from neilfpp_method.data.views import View

PLACE = np.array([1.0, -2.0, 0.5])
IMAGE = np.zeros((30, 40, 3), np.uint8)


@pytest.fixture
def image(tmp_path: Path) -> Path:
    return write_png(tmp_path / "image.png", IMAGE) or tmp_path / "image.png"


def looking(image: Path, eye: np.ndarray, at: np.ndarray) -> View:
    forward = (at - eye) / np.linalg.norm(at - eye)
    right = np.cross(forward, [0.05, 0.1, 1.0])
    right /= np.linalg.norm(right)
    w2c = np.eye(4)
    w2c[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    w2c[:3, 3] = -w2c[:3, :3] @ eye
    return View("view", 0, Camera(40.0, 40.0, 20.0, 15.0, 40, 30, w2c), image)


def around(
    image: Path, count: int = 24, distance: float = 4.0, arc: float = 2 * np.pi, aim: float = 0.0
) -> list[View]:
    """Cameras on a part of a ring around the place, slightly above it; their aim deviates by up to `aim`."""
    random = np.random.default_rng(0)
    views = []
    for angle in np.arange(count) / count * arc:
        eye = PLACE + distance * np.array([np.cos(angle) * 0.9, np.sin(angle) * 0.9, np.sqrt(1 - 0.81)])
        views.append(looking(image, eye, PLACE + aim * random.uniform(-1, 1, 3)))
    return views


def room(count: int = 3000, half: float = 12.0) -> np.ndarray:
    """Points on an object at the place and on the walls of a room around it."""
    random = np.random.default_rng(1)
    walls = random.uniform(-half, half, (count, 3))
    walls[np.arange(count), random.integers(0, 3, count)] = half * random.choice([-1, 1], count)
    return np.concatenate([PLACE + random.normal(scale=0.3, size=(count, 3)), PLACE + walls])


def test_cameras_on_a_ring_look_at_its_middle(image):
    focus = find_focus(around(image))
    assert focus.center == pytest.approx(PLACE, abs=1e-6)
    assert focus.distance == pytest.approx(4.0)
    assert focus.looking.all()


def test_aim_is_averaged(image):
    focus = find_focus(around(image, count=60, aim=0.5))
    assert np.linalg.norm(focus.center - PLACE) < 0.15


def test_a_quarter_of_cameras_that_look_elsewhere_has_no_influence(image):
    random = np.random.default_rng(2)
    away = [
        looking(image, PLACE + 4 * d, PLACE + 4 * d + 10 * random.normal(size=3))
        for d in random.normal(size=(8, 3))
    ]
    focus = find_focus([*around(image), *away])
    assert np.linalg.norm(focus.center - PLACE) < 0.1
    assert focus.looking[:24].all()


def test_a_distant_background_does_not_define_the_box(image):
    views, points = around(image), room()
    assert box_of_points(points).scale > 10, "the box of all points holds the cameras"
    box = find_box(views, points)
    assert box.source == "focus"
    assert box.normalization.center == pytest.approx(tuple(PLACE), abs=1e-6)
    assert box.normalization.scale == pytest.approx(FOCUS_BOX_RADIUS * 4.0)
    distances = [np.linalg.norm(box.normalization.camera(view.camera).c2w[:, 3]) for view in views]
    assert min(distances) == pytest.approx(1 / FOCUS_BOX_RADIUS)


def test_points_that_end_before_the_cameras_define_the_box(image):
    thing = PLACE + np.random.default_rng(3).uniform(-1, 1, (500, 3))
    box = find_box(around(image), thing)
    assert box.source == "points"
    assert box.normalization == box_of_points(thing)


@pytest.mark.parametrize("turned", [0.0, 0.02])
def test_points_define_the_box_of_forward_facing_cameras(image, turned):
    """Cameras side by side that look in one direction, except for small random rotations."""
    random = np.random.default_rng(4)
    eyes = random.uniform(-1, 1, (20, 3)) * [1, 0, 1]
    views = [looking(image, eye, eye + [0, 10, 0] + 10 * turned * random.normal(size=3)) for eye in eyes]
    points = np.array([0, 20, 0]) + random.uniform(-8, 8, (500, 3))
    assert find_focus(views) is None
    assert find_box(views, points).source == "points"


def test_cameras_side_by_side_that_turn_towards_an_object_have_a_focus(image):
    focus = find_focus(around(image, count=9, arc=np.pi / 2))
    assert focus.center == pytest.approx(PLACE, abs=1e-6)


def test_two_cameras(image):
    apart, close = (around(image, count=2, arc=arc) for arc in (np.pi, 0.2))
    assert find_focus(apart).center == pytest.approx(PLACE, abs=1e-6)
    assert find_focus(close) is None, (
        "twelve degrees between them, and any depth may be that of a careless aim"
    )
    assert box_of_focus(close) is None


def test_cameras_that_look_outwards_have_no_focus(image):
    eyes = [PLACE + 0.5 * np.array([np.cos(a), np.sin(a), 0.0]) for a in np.linspace(0, 6, 12)]
    views = [looking(image, eye, PLACE + 20 * (eye - PLACE)) for eye in eyes]
    assert find_focus(views) is None
    assert find_box(views, room()).source == "points"
