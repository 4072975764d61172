"""Environment maps from files: valid files, their orientation, and refused files."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from neilfpp_method.data.files.images import write_exr, write_png
from neilfpp_method.errors import UserError
from neilfpp_method.relight.maps import check_map, map_names, read_map

AXES = {
    "+x": (1, 0, 0),
    "-x": (-1, 0, 0),
    "+y": (0, 1, 0),
    "-y": (0, -1, 0),
    "+z": (0, 0, 1),
    "-z": (0, 0, -1),
}


def with_spot(row: int, column: int, height: int = 16) -> np.ndarray:
    """A dark map with a bright block of 4×4 texels."""
    pixels = np.full((height, 2 * height, 3), 0.01, np.float32)
    pixels[max(row - 2, 0) : row + 2, max(column - 2, 0) : column + 2] = (3.0, 2.0, 1.0)
    return pixels


def brightest(path: Path, layout: str, rotate: float = 0.0) -> str:
    """The axis from which most of the light comes."""
    sky = read_map(path, layout, rotate).sky
    light = sky.lookup(torch.tensor(list(AXES.values()), dtype=torch.float32)).sum(-1)
    assert light.max() > 1
    return list(AXES)[int(light.argmax())]


@pytest.mark.parametrize(
    ("layout", "column", "axis"),
    [
        ("ours", 8, "+x"),
        ("ours", 16, "-y"),
        ("ours", 24, "-x"),
        ("common", 16, "+x"),
        ("common", 8, "+y"),
        ("common", 24, "-y"),
    ],
)
def test_the_azimuth_of_columns(tmp_path, layout, column, axis):
    """docs/light.md: this package has +x at a quarter of the width; Blender has +x at the centre and +y a
    quarter of the width to its left.
    """
    write_exr(tmp_path / "sun.exr", {"RGB": with_spot(8, column)})
    assert brightest(tmp_path / "sun.exr", layout) == axis


@pytest.mark.parametrize(("degrees", "axis"), [(90.0, "+y"), (180.0, "-x"), (-90.0, "-y"), (450.0, "+y")])
def test_light_is_rotated_counter_clockwise_about_z(tmp_path, degrees, axis):
    write_exr(tmp_path / "sun.exr", {"RGB": with_spot(8, 8)})
    assert brightest(tmp_path / "sun.exr", "ours", degrees) == axis


def test_the_first_row_is_at_the_zenith(tmp_path):
    pixels = np.full((16, 32, 3), 0.01, np.float32)
    pixels[:2] = 5.0
    write_exr(tmp_path / "zenith.exr", {"RGB": pixels})
    assert brightest(tmp_path / "zenith.exr", "ours") == brightest(tmp_path / "zenith.exr", "common") == "+z"


def test_stops_make_it_brighter(tmp_path):
    write_exr(tmp_path / "sun.exr", {"RGB": with_spot(8, 8)})
    plain, brighter = (
        read_map(tmp_path / "sun.exr", "ours", exposure=stops).sky.radiance for stops in (0.0, 2.0)
    )
    assert torch.equal(brighter, 4 * plain)


def test_other_types_of_files(tmp_path):
    radiance = with_spot(8, 8)
    cv2.imwrite(str(tmp_path / "sun.hdr"), radiance[..., ::-1])
    np.testing.assert_allclose(read_map(tmp_path / "sun.hdr", "ours").sky.radiance, radiance, rtol=0.02)
    write_png(tmp_path / "sun.png", np.full((16, 32, 3), 188, np.uint8))
    # sRGB 188/255 is half of the light of white.
    np.testing.assert_allclose(read_map(tmp_path / "sun.png", "ours").sky.radiance, 0.5, atol=0.005)
    write_exr(tmp_path / "grey.exr", {"Y": radiance[..., 0]})
    gray = read_map(tmp_path / "grey.exr", "ours").sky.radiance
    assert gray.shape == (16, 32, 3)
    assert (gray[..., 0] == gray[..., 2]).all()


def spoiled(value: float) -> np.ndarray:
    pixels = with_spot(8, 8)
    pixels[3, 3, 1] = value
    return pixels


@pytest.mark.parametrize(
    ("pixels", "words"),
    [
        (spoiled(np.nan), "NaN"),
        (spoiled(np.inf), "infinite"),
        (spoiled(-1.0), "negative"),
        (np.zeros((16, 32, 3), np.float32), "black"),
        (np.ones((16, 16, 3), np.float32), "twice as many columns"),
        (np.ones((2, 4, 3), np.float32), "2 rows"),
    ],
)
def test_invalid_radiance_is_refused(tmp_path, pixels, words):
    write_exr(tmp_path / "map.exr", {"RGB": pixels})
    with pytest.raises(UserError, match=words):
        read_map(tmp_path / "map.exr", "ours")


def test_slightly_negative_texels_are_set_to_black(tmp_path):
    write_exr(tmp_path / "map.exr", {"RGB": spoiled(-1e-5)})
    read = read_map(tmp_path / "map.exr", "ours")
    assert read.negative == 1
    assert read.sky.radiance[3, 3, 1] == 0


@pytest.mark.parametrize("name", ["missing.exr", "notes.txt"])
def test_invalid_images_are_refused(tmp_path, name):
    (tmp_path / "notes.txt").write_text("light")
    with pytest.raises(UserError, match=name):
        check_map(tmp_path / name)


def test_maps_get_unique_names():
    assert map_names([Path("a/sky.exr"), Path("b/dawn.hdr")]) == ["sky", "dawn"]
    assert map_names([Path("a/sky.exr"), Path("b/sky.exr"), Path("c/dawn.exr")]) == ["a-sky", "b-sky", "dawn"]
    with pytest.raises(UserError, match="two maps have this name"):
        map_names([Path("a/sky.exr"), Path("a/sky.hdr")])
    with pytest.raises(UserError, match="cannot name a folder"):
        map_names([Path("a/..exr")])
