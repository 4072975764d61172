"""Check of the lengths of the binary files of a COLMAP model.

pycolmap trusts the counts in a file: with one damaged number it loops for minutes, or allocates more memory
than there is. This module checks that a file is long enough for its counts before pycolmap reads it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from struct import Struct, error

__all__ = ["check_sizes"]

COUNT, SMALL_COUNT = Struct("<Q"), Struct("<I")
CAMERA_HEAD, PARAMETER = Struct("<iiQQ"), 8
MIN_PARAMETERS = 2
"""Smallest number of parameters of a camera: a focal length and at least one more."""
IMAGE_HEAD, POINT_IN_IMAGE = Struct("<I7dI"), 24
POINT_HEAD, OBSERVATION = Struct("<Q3d3Bd"), 8
RIG_ID, SENSOR, POSE = 4, 8, 56
FRAME_HEAD, DATA_ID = Struct("<II7d"), 16


def check_sizes(folder: Path) -> None:
    """Check that each binary file of a model is as long as its counts say.

    Raises:
        ValueError: a file is shorter than its header states.
    """
    for name, record_end in RECORDS.items():
        path = folder / f"{name}.bin"
        if not path.is_file():
            continue
        data = path.read_bytes()
        try:
            (count,) = COUNT.unpack_from(data)
            offset = COUNT.size
            for _ in range(count):
                offset = record_end(data, offset)
                if offset > len(data):
                    raise ValueError(f"{path.name} is shorter than its header states")
        except (error, IndexError) as end:
            raise ValueError(f"{path.name} is shorter than its header states") from end


def _camera(data: bytes, offset: int) -> int:
    # The number of parameters depends on the model, which pycolmap checks; a bound for the loop is enough.
    return offset + CAMERA_HEAD.size + MIN_PARAMETERS * PARAMETER


def _image(data: bytes, offset: int) -> int:
    end_of_name = data.index(b"\0", offset + IMAGE_HEAD.size) + 1
    (count,) = COUNT.unpack_from(data, end_of_name)
    return end_of_name + COUNT.size + count * POINT_IN_IMAGE


def _point(data: bytes, offset: int) -> int:
    offset += POINT_HEAD.size
    (count,) = COUNT.unpack_from(data, offset)
    return offset + COUNT.size + count * OBSERVATION


def _rig(data: bytes, offset: int) -> int:
    offset += RIG_ID
    (count,) = SMALL_COUNT.unpack_from(data, offset)
    offset += SMALL_COUNT.size + (SENSOR if count else 0)
    for _ in range(count - 1):
        offset += SENSOR
        offset += 1 + (POSE if data[offset] else 0)
    return offset


def _frame(data: bytes, offset: int) -> int:
    offset += FRAME_HEAD.size
    (count,) = SMALL_COUNT.unpack_from(data, offset)
    return offset + SMALL_COUNT.size + count * DATA_ID


RECORDS: Mapping[str, Callable[[bytes, int], int]] = {
    "cameras": _camera,
    "images": _image,
    "points3D": _point,
    "rigs": _rig,
    "frames": _frame,
}
