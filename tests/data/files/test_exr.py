"""EXR files of renderers with many layers and parts: which of them is the image."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from neilfpp_method.data.files.images import image_header, read_image
from neilfpp_method.errors import UserError

HEIGHT, WIDTH = 5, 7
RGB, OTHER = np.random.default_rng(0).uniform(0, 4, (2, HEIGHT, WIDTH, 3)).astype(np.float32)
SCANLINES = {"type": OpenEXR.scanlineimage}


def planes(prefix: str, pixels: np.ndarray, names: str = "RGB") -> dict[str, np.ndarray]:
    return {prefix + name: np.ascontiguousarray(pixels[..., i]) for i, name in enumerate(names)}


BEAUTY, DIFFUSE = planes("View.Combined.", RGB), planes("View.DiffCol.", OTHER)
DATA = {**planes("View.Normal.", OTHER, "XYZ"), "View.Depth.Z": OTHER[..., 0].copy()}


def written(path: Path, *parts: dict[str, np.ndarray]) -> Path:
    named = [OpenEXR.Part(dict(SCANLINES), channels, f"part {i}") for i, channels in enumerate(parts)]
    OpenEXR.File(named).write(str(path))
    return path


@pytest.mark.parametrize(
    "parts",
    [
        [{**BEAUTY, **DATA}],
        [{**DATA, **DIFFUSE, **BEAUTY}],
        [{**planes("beauty.", RGB), **planes("albedo.", OTHER), **planes("specular.", OTHER)}],
        [{**planes("diffuse.", OTHER), **planes("specular.", OTHER), **planes("", RGB)}],
        [planes("", OTHER, "XYZ"), planes("", RGB)],
        [{"Z": OTHER[..., 0].copy()}, planes("", RGB), planes("", OTHER)],
        [DATA, BEAUTY],
    ],
    ids=[
        "one layer",
        "Combined",
        "beauty",
        "unnamed layer",
        "colours before vectors",
        "first part with colours",
        "layer in a part",
    ],
)
def test_the_image_is_found_among_layers_and_parts(
    tmp_path: Path, parts: list[dict[str, np.ndarray]]
) -> None:
    path = written(tmp_path / "a.exr", *parts)
    assert (image_header(path).width, image_header(path).height) == (WIDTH, HEIGHT)
    image = read_image(path)
    assert np.array_equal(image.pixels, RGB)
    assert image.alpha is None


def test_the_alpha_is_that_of_the_layer(tmp_path: Path) -> None:
    alpha = np.full((HEIGHT, WIDTH), 0.25, np.float32)
    image = read_image(
        written(tmp_path / "a.exr", {**BEAUTY, "View.Combined.A": alpha, "View.Other.A": 0 * alpha})
    )
    assert np.array_equal(image.pixels, RGB)
    assert (image.alpha == 0.25).all()


@pytest.mark.parametrize("name", ["ViewLayer.Combined", "rgba", "RGB", "beauty"])
def test_of_several_parts_with_colours_the_name_decides(tmp_path: Path, name: str) -> None:
    parts = [
        OpenEXR.Part(dict(SCANLINES), planes("", OTHER), "albedo"),
        OpenEXR.Part(dict(SCANLINES), planes("", RGB), name),
    ]
    OpenEXR.File(parts).write(str(tmp_path / "a.exr"))
    assert np.array_equal(read_image(tmp_path / "a.exr").pixels, RGB)


def test_ambiguous_layers_are_refused(tmp_path: Path) -> None:
    path = written(tmp_path / "a.exr", {**DIFFUSE, **planes("View.GlossCol.", RGB)})
    for read in (image_header, read_image):
        with pytest.raises(
            UserError, match=r"a\.exr: no RGB or single channel among View\.DiffCol\.B, .*GlossCol"
        ):
            read(path)


def test_the_size_of_every_part_is_bounded(tmp_path: Path) -> None:
    path = written(tmp_path / "a.exr", planes("", RGB), {"Z": OTHER[..., 0].copy()})
    data = path.read_bytes()
    at = data.rindex(b"dataWindow\0box2i\0") + len(b"dataWindow\0box2i\0") + 4
    path.write_bytes(data[:at] + struct.pack("<4i", 0, 0, 199_999, 199_999) + data[at + 16 :])
    for read in (image_header, read_image):
        with pytest.raises(UserError, match=r"a\.exr: the header says 200000×200000"):
            read(path)


def test_a_truncated_file_is_reported_once(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = written(tmp_path / "a.exr", planes("", RGB))
    path.write_bytes(path.read_bytes()[:-60])
    with pytest.raises(UserError, match=r"a\.exr: cannot be read \(damaged, or cut off\)"):
        read_image(path)
    assert capfd.readouterr() == ("", "")
