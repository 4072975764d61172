"""Videos of images."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from neilfpp_method.data.files.images import write_png
from neilfpp_method.errors import UserError
from neilfpp_method.relight import movie


def pictures(folder, count: int = 3, height: int = 33, width: int = 48):
    """Grey images that become brighter from frame to frame; half of each is covered."""
    paths = []
    for k in range(count):
        rgba = np.full((height, width, 4), 60 * (k + 1), np.uint8)
        rgba[..., 3] = 255
        rgba[:, : width // 2, 3] = 0
        paths.append(folder / f"{k}.png")
        write_png(paths[-1], rgba)
    return paths


@pytest.mark.parametrize("encoder", ["opencv", "ffmpeg"])
def test_a_video_shows_the_images_over_black(tmp_path, monkeypatch, encoder):
    if encoder == "ffmpeg":
        pytest.importorskip("imageio_ffmpeg")
    monkeypatch.setattr(movie, "_has_ffmpeg", lambda: encoder == "ffmpeg")
    movie.write_movie(tmp_path / "film.mp4", pictures(tmp_path))
    film = cv2.VideoCapture(str(tmp_path / "film.mp4"))
    frames = []
    while True:
        there, frame = film.read()
        if not there:
            break
        frames.append(frame)
    assert [frame.shape for frame in frames] == 3 * [(32, 48, 3)]
    for k, frame in enumerate(frames):
        assert frame[:, 30:].mean() == pytest.approx(60 * (k + 1), abs=6)
        assert frame[:, :18].mean() < 6
    assert {path.name for path in tmp_path.iterdir()} == {"film.mp4", "0.png", "1.png", "2.png"}


def test_without_an_encoder_there_is_an_error_and_no_file(tmp_path, monkeypatch):
    monkeypatch.setattr(movie, "_has_ffmpeg", lambda: False)
    monkeypatch.setattr(movie, "CODEC", "????")
    with pytest.raises(UserError, match="no MP4 encoder"):
        movie.write_movie(tmp_path / "film.mp4", pictures(tmp_path, 1))
    assert {path.name for path in tmp_path.iterdir()} == {"0.png"}
