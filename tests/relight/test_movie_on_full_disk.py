"""A video is written as a whole or not at all, wherever the disk is full."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from neilfpp_method.data.files.images import write_png
from neilfpp_method.errors import UserError
from neilfpp_method.relight import movie
from tests.hard_cases.faults.limits import largest_file


@pytest.mark.parametrize("encoder", ["opencv", "ffmpeg"])
def test_a_video_has_all_of_its_frames(tmp_path, monkeypatch, capfd, encoder):
    if encoder == "ffmpeg":
        pytest.importorskip("imageio_ffmpeg")
    monkeypatch.setattr(movie, "_has_ffmpeg", lambda: encoder == "ffmpeg")
    draw, pictures, path = np.random.default_rng(0), [], tmp_path / "film.mp4"
    for k in range(12):
        pictures.append(tmp_path / f"{k}.png")
        write_png(pictures[-1], draw.integers(0, 255, (48, 64, 3), dtype=np.uint8))
    movie.write_movie(path, pictures)
    size = path.stat().st_size
    for limit in (0, 10, 1000, size // 2, size - 1):
        path.unlink(missing_ok=True)
        with largest_file(limit), pytest.raises(UserError, match=r"film\.mp4: cannot be written"):
            movie.write_movie(path, pictures)
        assert not list(tmp_path.glob("*.mp4")) + list(tmp_path.glob(".*"))
    with largest_file(size):
        movie.write_movie(path, pictures)
    film, frames = cv2.VideoCapture(str(path)), 0
    while film.grab():
        frames += 1
    assert frames == 12
    assert capfd.readouterr().err == ""


def test_a_frame_that_is_missing_is_reported(tmp_path, monkeypatch):
    """Encoders can lose frames without an error."""
    pictures = [tmp_path / f"{k}.png" for k in range(3)]
    for path in pictures:
        write_png(path, np.full((16, 16, 3), 128, np.uint8))
    whole = movie._by_opencv
    monkeypatch.setattr(movie, "_has_ffmpeg", lambda: False)
    monkeypatch.setattr(movie, "_by_opencv", lambda path, pictures: whole(path, pictures[:2]))
    with pytest.raises(UserError, match=r"cannot be written \(2 of 3 frames can be read\)"):
        movie.write_movie(tmp_path / "film.mp4", pictures)
    assert not list(tmp_path.glob("*.mp4"))
