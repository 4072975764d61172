"""Exposures from EXIF, written by Pillow, and from lists."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from neilfpp_method.data.brackets.photo_exposure import exposures_of, photo_exposure, read_exposures
from neilfpp_method.errors import UserError
from tests.data.brackets.test_folder import write_photograph


def test_exposure_from_exif(tmp_path: Path) -> None:
    gray = np.full((4, 4, 3), 0.5)
    write_photograph(tmp_path / "a.jpg", gray, 1 / 60)
    assert photo_exposure(tmp_path / "a.jpg") == pytest.approx(1 / 60)
    exif = Image.Exif()
    exif[0x8769] = {0x829A: IFDRational(1, 60), 0x829D: IFDRational(4, 1), 0x8827: 400}
    Image.fromarray(np.zeros((4, 4, 3), np.uint8)).save(tmp_path / "b.jpg", exif=exif)
    assert photo_exposure(tmp_path / "b.jpg") == pytest.approx(1 / 60 * 4 / 16)
    write_photograph(tmp_path / "c.png", gray)
    assert photo_exposure(tmp_path / "c.png") is None
    (tmp_path / "d.nef").write_bytes(b"no image")
    assert photo_exposure(tmp_path / "d.nef") is None
    with pytest.raises(UserError, match=r"c\.png: no exposure time; write exposures\.txt"):
        exposures_of(tmp_path, [tmp_path / "c.png"])


@pytest.mark.parametrize(("time", "aperture"), [(1e300, 1e-50), (1e-300, 1e50), (1.0, 1e200), (1.0, 1e-200)])
def test_numbers_of_exif_without_a_finite_product(tmp_path: Path, monkeypatch, time, aperture) -> None:
    """EXIF may hold numbers of double precision, which Pillow does not write."""
    Image.fromarray(np.zeros((4, 4, 3), np.uint8)).save(tmp_path / "a.jpg")
    entries = {0x829A: time, 0x829D: aperture}
    monkeypatch.setattr(Image.Exif, "get_ifd", lambda *_: entries)
    assert photo_exposure(tmp_path / "a.jpg") is None


def test_exposures_from_a_file(tmp_path: Path) -> None:
    (tmp_path / "exposures.txt").write_text("# seconds\na.jpg 1/60\nsub/a b.jpg  2.5  # long\n\n")
    images = [tmp_path / "a.jpg", tmp_path / "sub" / "a b.jpg"]
    assert list(exposures_of(tmp_path, images).values()) == [pytest.approx(1 / 60), 2.5]
    (tmp_path / "exposures.json").write_text('{"a.jpg": 0.25, "a b.jpg": "1/8"}')
    assert list(exposures_of(tmp_path, images).values()) == [0.25, 0.125]
    with pytest.raises(UserError, match=r"c\.jpg: no exposure time; add it to .*exposures\.json"):
        exposures_of(tmp_path, [tmp_path / "c.jpg"])


@pytest.mark.parametrize(
    "text",
    [
        "a.jpg 0",
        "a.jpg -1",
        "a.jpg nan",
        "a.jpg 1/0",
        "a.jpg",
        "a.jpg fast",
        "a.jpg 1e999",
        "a.jpg 1e-9999999999",
    ],
)
@pytest.mark.timeout(20)
def test_a_bad_list_of_exposures_is_named(tmp_path: Path, text: str) -> None:
    (tmp_path / "exposures.txt").write_text(text)
    with pytest.raises(UserError, match=r"exposures\.txt"):
        read_exposures(tmp_path / "exposures.txt")
