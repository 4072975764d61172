"""Files of the truth as published datasets lay them out beside the images of a capture."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from neilfpp_method.data.images import ImageFile, read_image
from neilfpp_method.data.scaling import file_size
from neilfpp_method.data.views import View, inside
from neilfpp_method.errors import UserError

__all__ = ["alpha_of", "check_full_size", "existing", "read_beside", "read_map"]


def check_full_size(protocol: str, view: View) -> None:
    """That a view has the size of its files, as the truth beside them has.

    Raises:
        UserError: it was scaled.
    """
    if (view.camera.width, view.camera.height) != file_size(view):
        raise UserError(
            f"the protocol {protocol} measures at the size of the files", "leave --scale and --width out"
        )


def existing(root: Path, *paths: Path) -> Path | None:
    """The first of the paths that is a file; none of them: none.

    Raises:
        UserError: a path leads out of `root`.
    """
    return next((path for path in paths if inside(root, path).is_file()), None)


def read_beside(path: Path, view: View) -> ImageFile:
    """An image of the truth, of the size of the view.

    Raises:
        UserError: it cannot be read, is of another size, or has a value that is not finite.
    """
    image = read_image(path)
    height, width, _ = image.pixels.shape
    if (width, height) != (view.camera.width, view.camera.height):
        raise UserError(
            f"{path}: {width}×{height} pixels where the view has {view.camera.width}×{view.camera.height}",
            "render it again in the size of the view",
        )
    if not np.isfinite(image.pixels).all():
        raise UserError(f"{path}: a pixel is not finite", "render it again")
    return image


def alpha_of(image: ImageFile) -> Float[np.ndarray, "H W 1"]:
    """The alpha of an image; 1 where it has none."""
    alpha = np.ones(image.pixels.shape[:2], np.float32) if image.alpha is None else image.alpha
    return alpha[..., None]


def read_map(path: Path, shape: tuple[int, ...]) -> Float[np.ndarray, "*shape"]:
    """An array of numbers from a `.npy` file, of the shape that it must have.

    Raises:
        UserError: it cannot be read, holds anything but numbers, or has another shape.
    """
    try:
        # Mapped, so that its shape is known before any of it is in memory; a pickle is refused.
        values = np.load(path, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise UserError(f"{path}: cannot be read as an array", "download it again") from error
    if values.shape != shape or values.dtype.kind not in "fiu":
        raise UserError(
            f"{path}: {values.dtype} of shape {values.shape}, where numbers of shape {shape} are needed",
            "download it again",
        )
    return np.asarray(values, dtype=np.float32)
