"""Write images as an MP4 video: H.264 with imageio-ffmpeg if it is installed, else MPEG-4 with OpenCV."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from neilfpp_method.data.files.atomic_file import replacing
from neilfpp_method.data.files.images import read_image
from neilfpp_method.errors import UserError

__all__ = ["write_movie"]

FRAMES_PER_SECOND = 24
CODEC = "mp4v"
"""OpenCV's code of MPEG-4."""
QUALITY = 8
"""Quality of H.264 in imageio-ffmpeg, out of 10."""


def write_movie(path: Path, pictures: Sequence[Path]) -> None:
    """Write PNG files of equal size as a video, composited over black.

    Width and height are cropped to even numbers, which the encoders require.

    Raises:
        UserError: an image cannot be read, there is no encoder, or the video cannot be written.
    """
    with replacing(path) as temporary:
        try:
            with _quiet():
                (_by_ffmpeg if _has_ffmpeg() else _by_opencv)(temporary, pictures)
        except _NoEncoder as error:
            remedy = "pip install 'neilfpp-method[movie]', or encode the PNG files with another program"
            raise UserError(f"{path}: no MP4 encoder found", remedy) from error
        # Encoders do not report that the disk is full.
        written = _count_frames(temporary) if _has_all_boxes(temporary) else 0
        if written != len(pictures):
            raise OSError(f"{written} of {len(pictures)} frames can be read")


class _NoEncoder(Exception):
    """OpenCV has no MPEG-4 encoder."""


def _has_all_boxes(path: Path) -> bool:
    """Whether an MP4 file ends where its last box ends (ISO 14496-12, §4.2).

    FFmpeg's reader takes some truncated files for complete, and prints messages about others.
    """
    content, begin = path.read_bytes(), 0
    while begin + 8 <= len(content):
        size = int.from_bytes(content[begin : begin + 4], "big")
        # 1: the size, of 64 bits, follows the name of the box.
        size = int.from_bytes(content[begin + 8 : begin + 16], "big") if size == 1 else size
        begin += max(size, 8)
    return begin == len(content) > 0


def _count_frames(path: Path) -> int:
    """The number of frames that can be decoded."""
    film, count = cv2.VideoCapture(str(path)), 0
    while film.grab():
        count += 1
    film.release()
    return count


@contextmanager
def _quiet() -> Iterator[None]:
    """OpenCV prints a line for each frame that it cannot write."""
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(level)


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
    # The package is installed, but not the program.
    except RuntimeError:
        return False


def _by_ffmpeg(path: Path, pictures: Sequence[Path]) -> None:
    import imageio_ffmpeg

    writer = None
    for frame in _frames(pictures):
        if writer is None:
            size = (frame.shape[1], frame.shape[0])
            writer = imageio_ffmpeg.write_frames(
                str(path), size, fps=FRAMES_PER_SECOND, quality=QUALITY, macro_block_size=2
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
            if not writer.isOpened():
                # On a full disk, this is the error to report.
                path.write_bytes(bytes(1024))
                raise _NoEncoder
        writer.write(frame[..., ::-1])
    if writer is not None:
        writer.release()
