"""Pictures as an MP4: H.264 by imageio-ffmpeg where that is installed, else MPEG-4 by OpenCV."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from neilfpp_method.data.images import read_image, replacing
from neilfpp_method.errors import UserError

__all__ = ["write_movie"]

FRAMES_PER_SECOND = 24
CODEC = "mp4v"


def write_movie(path: Path, pictures: Sequence[Path]) -> None:
    """Write PNG files of one size as a film, over black.

    Sides are cut to even numbers of pixels, as the encoders need.

    Raises:
        UserError: a picture cannot be read, no encoder is here, or the film cannot be written.
    """
    with replacing(path) as temporary:
        (_by_ffmpeg if _has_ffmpeg() else _by_opencv)(temporary, pictures)
        if not temporary.is_file() or not temporary.stat().st_size:
            raise UserError(
                f"{path}: no MP4 encoder here", "install imageio-ffmpeg, or make a film of the PNG files"
            )


def _frames(pictures: Sequence[Path]) -> Iterator[UInt8[np.ndarray, "H W 3"]]:
    for path in pictures:
        image = read_image(path)
        pixels = image.pixels if image.alpha is None else image.pixels * image.alpha[..., None]
        height, width = (side // 2 * 2 for side in pixels.shape[:2])
        yield np.ascontiguousarray(np.rint(255 * pixels[:height, :width]).astype(np.uint8))


def _has_ffmpeg() -> bool:
    try:
        import imageio_ffmpeg
    except ImportError:
        return False
    try:
        return bool(imageio_ffmpeg.get_ffmpeg_exe())
    except RuntimeError:  # the package is there, and no program
        return False


def _by_ffmpeg(path: Path, pictures: Sequence[Path]) -> None:
    import imageio_ffmpeg

    writer = None
    for frame in _frames(pictures):
        if writer is None:
            size = (frame.shape[1], frame.shape[0])
            writer = imageio_ffmpeg.write_frames(
                str(path), size, fps=FRAMES_PER_SECOND, quality=8, macro_block_size=2
            )
            writer.send(None)
        writer.send(frame)
    if writer is not None:
        writer.close()


def _by_opencv(path: Path, pictures: Sequence[Path]) -> None:
    writer = None
    for frame in _frames(pictures):
        if writer is None:
            size = (frame.shape[1], frame.shape[0])
            writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*CODEC), FRAMES_PER_SECOND, size)
        writer.write(frame[..., ::-1])
    if writer is not None:
        writer.release()
