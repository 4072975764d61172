"""Reading of environment maps: valid files are read, and invalid ones are refused in one line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from neilfpp_method.data.files import environment_map
from neilfpp_method.data.files.environment_map import check_environment, read_environment
from neilfpp_method.data.files.images import write_exr, write_png
from neilfpp_method.errors import UserError


def write(path: Path, pixels: np.ndarray, channels: str = "RGB") -> Path:
    write_exr(path, {channels: pixels.astype(np.float32)})
    return path


def test_rows_and_columns_keep_their_order(tmp_path):
    pixels = np.arange(5 * 9 * 3).reshape(5, 9, 3)
    radiance = read_environment(write(tmp_path / "sky.exr", pixels))
    np.testing.assert_array_equal(radiance.numpy(), np.moveaxis(pixels, -1, 0))


def test_a_single_channel_is_copied_to_all_three(tmp_path):
    radiance = read_environment(write(tmp_path / "sky.exr", np.arange(32).reshape(4, 8), "Y"))
    assert radiance.shape == (3, 4, 8)
    assert (radiance[0] == radiance[2]).all()


def spoilt(value: float) -> np.ndarray:
    pixels = np.ones((4, 8, 3))
    pixels[2, 3, 1] = value
    return pixels


@pytest.mark.parametrize(
    ("pixels", "complaint"),
    [
        (spoilt(np.nan), "NaN or infinite"),
        (spoilt(np.inf), "NaN or infinite"),
        (spoilt(-0.1), "negative"),
        (np.zeros((4, 8, 3)), "black"),
        (np.ones((3, 8, 3)), "3 rows and 8 columns"),
        (np.ones((4, 7, 3)), "4 rows and 7 columns"),
    ],
)
def test_invalid_radiance_is_refused(tmp_path, pixels, complaint):
    path = write(tmp_path / "sky.exr", pixels)
    with pytest.raises(UserError, match=complaint) as caught:
        read_environment(path)
    assert str(path) in str(caught.value)
    assert caught.value.remedy


def test_slightly_negative_texels_are_set_to_black(tmp_path):
    radiance = read_environment(write(tmp_path / "sky.exr", spoilt(-1e-3)))
    assert radiance[1, 2, 3] == 0
    assert radiance.amin() == 0


def test_the_size_is_refused_before_pixels_are_read(tmp_path, monkeypatch):
    path = write(tmp_path / "sky.exr", np.ones((12, 24, 3)))
    monkeypatch.setattr(environment_map, "MAX_ROWS", 11)
    path.write_bytes(path.read_bytes()[:-40])  # whoever reads the pixels meets the damage
    with pytest.raises(UserError, match="12 rows and 24 columns"):
        check_environment(path)


def test_other_files_are_refused(tmp_path):
    write_png(tmp_path / "sky.png", np.ones((4, 8, 3), np.uint8))
    (tmp_path / "text.exr").write_text("light")
    for name, complaint in (
        ("sky.png", "EXR file"),
        ("text.exr", "cannot be read"),
        ("none.exr", "no such image"),
    ):
        with pytest.raises(UserError, match=complaint):
            check_environment(tmp_path / name)
