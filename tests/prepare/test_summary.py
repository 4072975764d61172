"""The summary for the user: lines, remarks and images."""

from __future__ import annotations

import numpy as np
import pytest

from neilfpp_method.data.cameras.camera import Camera
from neilfpp_method.data.point_cloud import WorldPoints
from neilfpp_method.data.views import Normalization, View
from neilfpp_method.errors import UserError
from neilfpp_method.prepare.mapping import refuse_partial
from neilfpp_method.prepare.matching import choose_pairing
from neilfpp_method.prepare.pictures import MISSING, TEST, TRAIN, draw_fit, draw_scene
from neilfpp_method.prepare.summary import Placement, Summary, remarks_on
from tests.prepare.textured_corner import pose

PLACED = (Placement("a", 900, 300, 0.4), Placement("b", 80, 40, 1.9), Placement("c", 500, None, None))
CAMERA = {"model": "PINHOLE", "images": 2, "parameters": {"fx": 500.0}, "focal_from_exif": False}


def test_remarks_name_the_images():
    missing, models, poor, off, exif = remarks_on(PLACED, (2, 1), [CAMERA])
    assert missing.endswith(": c")
    assert "2 separate models of 2, 1 images" in models
    assert poor.endswith(" in b")
    assert off.endswith(" in b")
    assert "EXIF" in exif
    assert remarks_on(PLACED[:1], (1,), [{**CAMERA, "focal_from_exif": True}]) == []


def test_lines_have_the_figures():
    lines = Summary(PLACED, (2, 1), (CAMERA,), 2, 77, "sparse", 1.5, "focus", ("careful",)).lines
    assert "2 of 3 images placed, reprojection error 1.15 pixels" in lines[0]
    assert "fx 500" in lines[1]
    assert "77 points" in lines[2]
    assert (
        lines[3] == "radius of the scene: 1.5, from the point that the cameras look at, because the points "
        "extend far beyond it"
    )
    assert lines[4] == "note: careful"
    assert "with the poses" in Summary((), (), (), 5, 0, "none", 1.0, "box", ()).lines[0]


def test_a_small_model_is_refused_with_a_remedy():
    refuse_partial(["x"] * 4, [6, 2])  # six of ten are enough
    with pytest.raises(
        UserError, match=r"only 5 of 10 images.*models of 4; not placed: x, x, x, …; .*--allow-partial"
    ):
        refuse_partial(["x"] * 5, [5, 4])


def test_many_images_are_not_compared_with_all_others():
    assert choose_pairing("auto", 200) == "exhaustive"
    assert choose_pairing("auto", 201) == "vocabulary"
    assert choose_pairing("sequential", 10) == "sequential"


def has(picture: np.ndarray, color: tuple[int, int, int]) -> bool:
    return bool((np.abs(picture.astype(int) - color).max(axis=-1) <= 12).any())


def test_the_images_show_cameras_points_and_failures(tmp_path):
    views = [
        View(f"{i}", i, Camera(200.0, 200.0, 80.0, 60.0, 160, 120, pose(i, 5)), tmp_path / f"{i}.png")
        for i in range(5)
    ]
    up = np.tile([0.0, 0.0, 1.0], (500, 1))
    points = WorldPoints(np.random.default_rng(0).random((500, 3)), up)
    box = Normalization(0.8, (0.5, 0.5, 0.5))
    scene = draw_scene(views, {"4"}, points, box)
    assert has(scene, TRAIN)
    assert has(scene, TEST)
    assert has(scene, (128, 128, 255))
    assert not has(scene, MISSING)
    assert draw_scene(views, (), WorldPoints(up[:0], up[:0]), box).shape == scene.shape
    fit = draw_fit(PLACED, scene.shape[1])
    assert fit.shape[1] == scene.shape[1]
    assert has(fit, MISSING)
    assert not has(draw_fit(PLACED[:2], 800), MISSING)
