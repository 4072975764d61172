"""The comparison of an asset's textures with the material of its run."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from benchmarks.asset import TILE, agreement, field_values, random_points, sheet
from neilfpp_method.structures import Material
from tests.export.asset.balls import ball_run, material, write_ball


@pytest.fixture(scope="module")
def ball(tmp_path_factory):
    folder = tmp_path_factory.mktemp("ball")
    run = ball_run(folder)
    write_ball(run, folder / "asset")
    return run, folder / "asset"


def in_scene(run, position):
    return (position - np.array(run.capture.normalization.center)) / run.capture.normalization.scale


def test_the_textures_of_a_smooth_material_agree(ball):
    run, folder = ball
    points = random_points(folder / "asset.glb", 4000)
    found = agreement(points.values, field_values(run, in_scene(run, points.position)))
    assert list(found) == ["base colour", "roughness", "metallic"]
    for figures in found.values():
        assert figures.share > 0.995
        assert figures.largest < 2


def test_another_material_does_not(ball, monkeypatch):
    """Roughness and metallic are exchanged, and the base colour is 0.03 brighter."""
    run, folder = ball
    points = random_points(folder / "asset.glb", 4000)

    def other(x):
        true = material(x)
        return Material(true.base_color + 0.03, true.metallic, true.roughness)

    monkeypatch.setattr(run.model, "materials", other)
    for figures in agreement(points.values, field_values(run, in_scene(run, points.position))).values():
        assert figures.share < 0.2
        assert figures.largest > 4


def test_the_share_counts_the_worst_channel():
    truth = np.full((4, 5), 100.0)
    values = truth.copy()
    values[0, 1], values[1, 3] = 103, 102
    found = agreement(values, truth)
    assert [figures.share for figures in found.values()] == [0.75, 1.0, 1.0]
    assert found["base colour"].largest == pytest.approx(3 * 0.97)


def test_the_sheet_shows_four_textures(ball, tmp_path):
    _, folder = ball
    sheet(folder, tmp_path / "sheet.png")
    picture = np.asarray(Image.open(tmp_path / "sheet.png"))
    assert picture.shape == (TILE, 4 * TILE, 3)
    names = ("base_color", "roughness", "metallic", "normal")
    for tile, name in zip(np.split(picture, 4, axis=1), names, strict=True):
        texture = np.asarray(Image.open(folder / "textures" / f"{name}.png").convert("RGB"))
        np.testing.assert_allclose(tile.mean((0, 1)), texture.mean((0, 1)), atol=2)
