"""Inverted masks are recognised, also of objects that the images cut off; correct masks never are."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from neilfpp_method.data.cameras.camera import Camera
from neilfpp_method.data.focus import find_focus
from neilfpp_method.data.hulls.inverted_masks import look_inverted
from neilfpp_method.data.hulls.silhouettes import Outline
from neilfpp_method.data.views import View
from tests.data.make_capture import CENTER, DISTANCE, RADIUS, camera_pose

VIEWS, WIDTH, HEIGHT = 12, 64, 48


def silhouette(i: int, zoom: float = 1.0, aside: float = 0.0) -> Outline:
    """The silhouette of the sphere of `make_capture`; `aside` turns the camera by that share of its image."""
    focal, center = zoom * 1.4 * HEIGHT, (WIDTH * (0.5 + aside), HEIGHT / 2)
    w2c = camera_pose(i, VIEWS)
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = np.stack([(u - center[0]) / focal, (v - center[1]) / focal, np.ones_like(u)], axis=-1)
    to = w2c[:3, :3] @ CENTER + w2c[:3, 3]
    away = np.linalg.norm(np.cross(rays, to), axis=-1) / np.linalg.norm(rays, axis=-1)
    assert np.linalg.norm(to) == pytest.approx(DISTANCE)
    camera = Camera(focal, focal, *center, WIDTH, HEIGHT, w2c)
    return Outline(View(f"{i:03d}", i, camera, Path("none.png")), away < RADIUS)


def inverted(outlines: list[Outline]) -> list[Outline]:
    return [replace(outline, inside=~outline.inside) for outline in outlines]


@pytest.mark.parametrize("zoom", [0.2, 1.0, 1.8])
def test_inverted_masks(zoom: float) -> None:
    """With the largest zoom, the borders of the images cut the sphere off."""
    outlines = [silhouette(i, zoom) for i in range(VIEWS)]
    assert all(outline.complete for outline in outlines) == (zoom < 1.7)
    assert look_inverted(inverted(outlines))
    assert not look_inverted(outlines)


def test_inverted_masks_of_an_object_that_no_camera_looks_at() -> None:
    outlines = [silhouette(i, 0.5, aside=0.3 * (-1) ** (i // 2)) for i in range(VIEWS)]
    assert all(outline.complete for outline in outlines)
    assert find_focus([outline.view for outline in outlines]) is None
    assert look_inverted(inverted(outlines))
    assert not look_inverted(outlines)


@pytest.mark.parametrize("zoom", [2.0, 3.0, 4.0, 8.0])
def test_an_object_that_fills_the_frame(zoom: float) -> None:
    assert not look_inverted([silhouette(i, zoom) for i in range(VIEWS)])


def test_holes_at_different_places() -> None:
    """The background is seen through the object, elsewhere in every view."""
    noise, outlines = np.random.default_rng(0), []
    for i in range(VIEWS):
        mask = np.ones((HEIGHT, WIDTH), bool)
        row, column = noise.integers(4, HEIGHT - 14), noise.integers(4, WIDTH - 14)
        mask[row : row + 10, column : column + 10] = False
        outlines.append(replace(silhouette(i), inside=mask))
    assert not look_inverted(outlines)


def test_masks_of_whole_images_and_of_nothing() -> None:
    for value in (True, False):
        full = np.full((HEIGHT, WIDTH), value)
        assert not look_inverted([replace(silhouette(i), inside=full) for i in range(VIEWS)])
    assert not look_inverted(inverted([silhouette(0)])), "one view has no common region"
