"""Camera RAW: a DNG with known sensor values, developed by LibRaw, gives these values in linear sRGB."""

from __future__ import annotations

import sys
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
import tifffile

from neilfpp_method.data.brackets.folder import find_brackets, merge_brackets
from neilfpp_method.data.files import raw
from neilfpp_method.data.files.images import read_image
from neilfpp_method.data.files.raw import develop
from neilfpp_method.errors import UserError

BLACK, WHITE = 512, 16_383
HEIGHT, WIDTH = 64, 96
XYZ_TO_SRGB = np.array(
    [[3.24045, -1.53714, -0.49853], [-0.96927, 1.87601, 0.04156], [0.05564, -0.20403, 1.05723]]
)
NEUTRAL = (0.5, 1.0, 0.8)
"""Response of the sensor's channels to white light; red is half of green."""


def write_dng(path: Path, light: np.ndarray, as_shot: tuple[float, float, float] = NEUTRAL) -> None:
    """Write the image of a Bayer sensor (RGGB) behind sRGB filters with the transmittances NEUTRAL. Light of
    1 in green is its white level.
    """
    channel = np.array([[0, 1], [1, 2]])[np.mgrid[:HEIGHT, :WIDTH][0] % 2, np.mgrid[:HEIGHT, :WIDTH][1] % 2]
    answer = np.take_along_axis(light * NEUTRAL, channel[..., None], axis=2)[..., 0]
    sensor = np.rint(BLACK + answer.clip(0, 1) * (WHITE - BLACK)).astype(np.uint16)

    def rational(values) -> list[int]:
        return [v for value in np.ravel(values) for v in (round(value * 10_000), 10_000)]

    matrix = np.diag(NEUTRAL) @ XYZ_TO_SRGB
    tags = [
        (33421, "H", 2, (2, 2), True),  # CFARepeatPatternDim
        (33422, "B", 4, (0, 1, 1, 2), True),  # CFAPattern
        (50706, "B", 4, (1, 4, 0, 0), True),  # DNGVersion
        (50708, "s", 0, "Test camera", True),  # UniqueCameraModel
        (50714, "H", 1, BLACK, True),
        (50717, "H", 1, WHITE, True),
        (50721, "2i", 9, rational(matrix), True),  # ColorMatrix1: XYZ to the sensor
        (50728, "2I", 3, rational(as_shot), True),  # AsShotNeutral
        (50778, "H", 1, 21, True),  # CalibrationIlluminant1: D65
    ]
    tifffile.imwrite(path, sensor, photometric="cfa", extratags=tags)


def patches() -> np.ndarray:
    """Eight constant colours, each a column of 12 pixels."""
    rng = np.random.default_rng(0)
    return np.repeat(rng.uniform(0.1, 0.9, (1, 8, 3)), 12, axis=1).repeat(HEIGHT, axis=0)


def middles(values: np.ndarray) -> np.ndarray:
    """The colour of each column, away from its borders."""
    return values.reshape(HEIGHT, 8, 12, -1)[8:-8, :, 4:8].mean(axis=(0, 2))


@pytest.fixture
def rawpy():
    return pytest.importorskip("rawpy")


def test_values_are_linear_and_share_one_scale(tmp_path: Path, rawpy) -> None:
    scales = []
    for i, (exposure, as_shot) in enumerate([(1.0, NEUTRAL), (0.25, NEUTRAL), (0.25, (0.9, 1.0, 0.4))]):
        write_dng(tmp_path / f"{i}.dng", exposure * patches(), as_shot)
        developed = develop(tmp_path / f"{i}.dng")
        assert developed.pixels.shape == (HEIGHT, WIDTH, 3)
        assert developed.pixels.dtype == np.float32
        assert developed.white_balance == pytest.approx((1 / as_shot[0], 1.0, 1 / as_shot[2]), rel=1e-3)
        assert developed.valid.all()
        quotient = middles(developed.pixels) / (exposure * middles(patches()))
        assert np.allclose(quotient, quotient.mean(), rtol=0.02), "the same factor for all colours"
        scales.append(quotient.mean())
    assert np.allclose(scales, scales[0], rtol=0.005), "whatever the picture and its white balance"


def test_saturated_pixels_are_marked(tmp_path: Path, rawpy) -> None:
    light = np.full((HEIGHT, WIDTH, 3), 0.3)
    light[20:40, 30:50, 1] = 1.7
    write_dng(tmp_path / "a.dng", light)
    valid = develop(tmp_path / "a.dng").valid
    assert not valid[20:40, 30:50].any()
    assert valid[:17].all()
    assert valid[43:].all()
    assert valid[:, :27].all()


def test_raw_brackets_merge(tmp_path: Path, rawpy) -> None:
    (tmp_path / "photos" / "pose").mkdir(parents=True)
    light = patches() * np.exp2(np.linspace(-5, 2, 8)).repeat(12)[None, :, None]
    times = {"a.dng": "1/16", "b.dng": "1/4", "c.dng": "1"}
    for name, time in times.items():
        write_dng(tmp_path / "photos" / "pose" / name, light * float(Fraction(time)))
    (tmp_path / "photos" / "exposures.txt").write_text("".join(f"{n} {t}\n" for n, t in times.items()))
    merge_brackets(find_brackets(tmp_path / "photos"), tmp_path / "images", tmp_path / "valid")
    quotient = middles(read_image(tmp_path / "images" / "pose.exr").pixels) / middles(light)
    assert np.allclose(quotient, np.median(quotient), rtol=0.02)
    assert (read_image(tmp_path / "valid" / "pose.png").pixels == 1).all()


@pytest.mark.parametrize("content", [b"", b"II*\0 no raw file", b"x" * 4096])
def test_a_damaged_file_is_named(tmp_path: Path, rawpy, content: bytes) -> None:
    (tmp_path / "bad.nef").write_bytes(content)
    with pytest.raises(UserError, match=r"bad\.nef: cannot be developed"):
        develop(tmp_path / "bad.nef")


def test_without_rawpy_the_extra_is_named(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "rawpy", None)
    with pytest.raises(
        UserError, match=r"a\.nef: camera RAW needs rawpy; pip install 'neilfpp-method\[raw\]'"
    ):
        develop(tmp_path / "a.nef")


STAND_IN = """
import os, time
from contextlib import nullcontext
from types import SimpleNamespace
import numpy as np

class Raw:
    raw_image_visible, white_level = np.zeros((4, 6)), 1
    daylight_whitebalance = camera_whitebalance = [1.0, 1.0, 1.0, 1.0]

    def postprocess(self, **options):
        {decoding}
        return np.zeros((6, 4, 3), np.uint16)

def imread(path):
    return nullcontext(Raw())

ColorSpace, HighlightMode = SimpleNamespace(sRGB=1), SimpleNamespace(Clip=0)
"""
"""A module rawpy whose images have another size than their sensor, unless decoding ends before."""


@pytest.mark.parametrize(
    ("decoding", "problem"),
    [
        ("pass", "4×6 pixels from a sensor of 6×4"),
        ("os.abort()", r"cannot be developed \(LibRaw ended by signal 6\)"),
        ("os._exit(3)", r"cannot be developed \(LibRaw ended by status 3\)"),
        ("raise MemoryError", r"cannot be developed \(MemoryError\)"),
        ("np.zeros(1 << 33, np.uint8)", r"cannot be developed \(Unable to allocate 8.00 GiB"),
        ("time.sleep(600)", r"cannot be developed \(LibRaw did not finish within 2 s\)"),
    ],
    ids=["size", "crash", "exit", "error", "memory", "hang"],
)
def test_a_decoder_that_fails_ends_with_one_line(tmp_path: Path, monkeypatch, decoding, problem) -> None:
    (tmp_path / "rawpy.py").write_text(STAND_IN.format(decoding=decoding))
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.syspath_prepend(tmp_path)
    if "sleep" in decoding:
        monkeypatch.setattr(raw, "SECONDS", 2.0)
    with pytest.raises(UserError, match=rf"a\.raf: {problem}"):
        develop(tmp_path / "a.raf")
