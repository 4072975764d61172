"""Read files of the truth that published datasets store beside the images of a capture."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from jaxtyping import Float

from neilfpp_method.data.files.images import ImageFile, read_image
from neilfpp_method.data.files.number_arrays import array_of
from neilfpp_method.data.files.paths import inside
from neilfpp_method.data.scaling import file_size
from neilfpp_method.data.views import View
from neilfpp_method.errors import UserError

__all__ = ["alpha_of", "check_full_size", "existing", "read_array", "read_beside"]

LARGEST_NUMBER, LARGEST_HEADER = 8, 2**14
"""Bytes of a number and of the header of an NPY file."""


def check_full_size(protocol: str, view: View) -> None:
    """Check that a view has the size of its image file, which is the size of the truth.

    Raises:
        UserError: the view was resized.
    """
    if (view.camera.width, view.camera.height) != file_size(view):
        raise UserError(
            f"the protocol {protocol} measures at the size of the files", "leave --scale and --width out"
        )


def existing(root: Path, *paths: Path) -> Path | None:
    """Return the first of the paths that is a file, or None.

    Raises:
        UserError: a path leads out of `root`.
    """
    return next((path for path in paths if inside(root, path).is_file()), None)


def read_beside(path: Path, view: View) -> ImageFile:
    """Read an image of the truth that must have the size of the view.

    Raises:
        UserError: it cannot be read, has a different size, or has a value that is not finite.
    """
    image = read_image(path)
    height, width, _ = image.pixels.shape
    if (width, height) != (view.camera.width, view.camera.height):
        raise UserError(
            f"{path}: {width}×{height} pixels, but the view has {view.camera.width}×{view.camera.height}",
            "render it again in the size of the view",
        )
    if not np.isfinite(image.pixels).all():
        raise UserError(f"{path}: a pixel is not finite", "render it again")
    return image


def alpha_of(image: ImageFile) -> Float[np.ndarray, "H W 1"]:
    """The alpha of an image; 1 if the file has no alpha channel."""
    alpha = np.ones(image.pixels.shape[:2], np.float32) if image.alpha is None else image.alpha
    return alpha[..., None]


def read_array(path: Path, shape: tuple[int, ...]) -> Float[np.ndarray, "*shape"]:
    """Read an array of numbers with a given shape from a `.npy` file.

    Raises:
        UserError: it cannot be read, holds anything but numbers, or has a different shape.
    """
    try:
        size = path.stat().st_size
        if size > math.prod(shape) * LARGEST_NUMBER + LARGEST_HEADER:
            raise ValueError(f"{size} bytes")
        values = array_of(path.read_bytes())
    except (OSError, ValueError) as error:
        raise UserError(f"{path}: cannot be read as an array", "download it again") from error
    if values.shape != shape or values.dtype.kind not in "fiu":
        raise UserError(
            f"{path}: {values.dtype} of shape {values.shape}, but numbers of shape {shape} are needed",
            "download it again",
        )
    return np.asarray(values, dtype=np.float32)
