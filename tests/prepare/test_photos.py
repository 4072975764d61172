"""Names, cameras and exposures from the headers of photographs, and refused folders."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from neilfpp_method.data.files.images import read_image, write_exr, write_png
from neilfpp_method.errors import UserError
from neilfpp_method.prepare.matching_copies import relative_exposures, write_copies
from neilfpp_method.prepare.photos import read_photo, survey


def jpeg(path: Path, focal_35mm: int | None = None, model: str = "", time: float = 0.0) -> None:
    exif = Image.Exif()
    if model:
        exif[0x0110] = model
    details = exif.get_ifd(0x8769)
    if focal_35mm is not None:
        details[0xA405] = focal_35mm
    if time:
        details[0x829A] = time
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.full((30, 40, 3), 90, np.uint8)).save(path, exif=exif)


def exr(path: Path, value: float = 0.5) -> None:
    write_exr(path, {"RGB": np.full((30, 40, 3), value, np.float32)})


def test_names_cameras_and_focal_lengths(tmp_path):
    jpeg(tmp_path / "a" / "one.jpg", 24, "X100")
    jpeg(tmp_path / "b" / "one.jpg", 50, "X100")
    jpeg(tmp_path / "two.JPG")
    (tmp_path / ".thumbnails").mkdir()
    jpeg(tmp_path / ".thumbnails" / "one.jpg")
    (tmp_path / "notes.txt").write_text("not an image")
    photos = survey(tmp_path, "auto")
    assert [photo.name for photo in photos.items] == ["a-one", "b-one", "two"]
    assert [photo.focal for photo in photos.items] == [pytest.approx(24 / 36), pytest.approx(50 / 36), None]
    assert len({photo.device for photo in photos.items}) == 3
    assert not photos.linear
    assert survey(tmp_path, "linear").linear


def test_focal_lengths_that_no_lens_has_are_ignored(tmp_path):
    for i, focal in enumerate((1, 10_000, 10_001)):
        jpeg(tmp_path / f"{i}.jpg", focal)
    focals = [photo.focal for photo in survey(tmp_path, "auto").items]
    assert focals == [pytest.approx(1 / 36), pytest.approx(10_000 / 36), None]


def test_exif_gives_the_orientation_of_a_camera(tmp_path):
    for i, orientation in enumerate((None, 6, 8, 99)):
        exif = Image.Exif()
        if orientation:
            exif[0x0112] = orientation
        Image.new("RGB", (40, 30)).save(tmp_path / f"{i}.jpg", exif=exif)
    assert [photo.orientation for photo in survey(tmp_path, "auto").items] == [1, 6, 8, 99]


def test_photographs_in_other_formats_are_not_skipped(tmp_path):
    for i in range(3):
        exr(tmp_path / f"{i}.exr")
    (tmp_path / "IMG_7.HEIC").write_bytes(b"")
    (tmp_path / "IMG_7.MOV").write_bytes(b"")
    problems = survey(tmp_path, "auto").unreadable
    assert [path.name for path in problems] == ["IMG_7.HEIC"]
    assert "not an image format that is read" in problems[tmp_path / "IMG_7.HEIC"]
    for i in range(3):
        (tmp_path / f"{i}.exr").unlink()
    with pytest.raises(UserError, match=r"no images, and 1 that cannot be read .* frames of IMG_7\.MOV"):
        survey(tmp_path, "auto")


def test_unreadable_files_are_listed(tmp_path):
    for i in range(3):
        exr(tmp_path / f"{i}.exr")
    (tmp_path / "3.exr").write_bytes(b"nothing")
    photos = survey(tmp_path, "auto")
    assert len(photos.items) == 3
    assert "3.exr" in photos.unreadable[tmp_path / "3.exr"]
    (tmp_path / "2.exr").unlink()
    with pytest.raises(UserError, match="2 images, and 1 that cannot be read"):
        survey(tmp_path, "auto")


def test_pixels_without_valid_radiance_are_marked(tmp_path):
    pixels = np.full((30, 40, 3), 0.5, np.float32)
    pixels[0, 0], pixels[1, 1, 2], pixels[2, 2, 0] = np.nan, np.inf, -1.0
    write_exr(tmp_path / "a.exr", {"RGB": pixels})
    picture = read_photo(tmp_path / "a.exr")
    assert (~picture.valid).sum() == 3
    assert not picture.valid[[0, 1, 2], [0, 1, 2]].any()
    assert (picture.pixels[[0, 1, 2], [0, 1, 2]] == 0).all()
    write_png(tmp_path / "grey.png", np.full((30, 40), 128, np.uint8))
    assert read_photo(tmp_path / "grey.png").pixels.shape == (30, 40, 3)


def test_linear_copies_share_one_exposure(tmp_path):
    for name, value in (("dim", 10.0), ("middle", 20.0), ("bright", 40.0)):
        exr(tmp_path / f"{name}.exr", value)
    photos = survey(tmp_path, "auto")
    seen = []
    assert write_copies(photos, tmp_path / "work", lambda: seen.append(1)) == ()
    assert len(seen) == 3
    copies = {
        photo.name: read_image(tmp_path / "work" / f"{photo.name}.png").pixels.mean()
        for photo in photos.items
    }
    linear = {name: ((value + 0.055) / 1.055) ** 2.4 for name, value in copies.items()}
    assert linear["middle"] == pytest.approx(0.7, rel=0.02)  # the common level of the bright end
    assert linear["dim"] == pytest.approx(0.35, rel=0.02)
    assert copies["bright"] == 1.0


def test_display_values_are_copied_unchanged(tmp_path):
    for i in range(3):
        write_png(tmp_path / f"{i}.png", np.full((30, 40, 3), 50 * i, np.uint8))
    write_copies(survey(tmp_path, "auto"), tmp_path / "work", lambda: None)
    assert [
        read_image(tmp_path / "work" / f"{i}.png").pixels.mean() * 255 for i in range(3)
    ] == pytest.approx([0, 50, 100])


def test_exposures_are_used_if_all_are_known_and_pixels_are_linear(tmp_path):
    for name, time in (("a", 1 / 100), ("b", 1 / 50), ("c", 1 / 25)):
        jpeg(tmp_path / f"{name}.jpg", time=time)
    assert relative_exposures(survey(tmp_path, "linear")) == pytest.approx(
        {"a": 0.5, "b": 1.0, "c": 2.0}, rel=1e-3
    )
    assert set(relative_exposures(survey(tmp_path, "srgb")).values()) == {1.0}
    jpeg(tmp_path / "d.jpg")
    assert set(relative_exposures(survey(tmp_path, "linear")).values()) == {1.0}


def test_the_response_of_camera_raw_cannot_be_srgb(tmp_path):
    for i in range(3):
        (tmp_path / f"{i}.dng").write_bytes(b"")
    assert survey(tmp_path, "auto").linear
    with pytest.raises(UserError, match=r"0\.dng: camera RAW is developed to linear radiance"):
        survey(tmp_path, "srgb")
