"""Read the pixels of one view from its files: colours, mask and validity, at the size of its camera."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float32
from torch import Tensor

from neilfpp_method.data.files.images import ImageFile, read_image
from neilfpp_method.data.scaling import area_average, area_share, file_size
from neilfpp_method.data.views import View
from neilfpp_method.errors import UserError
from neilfpp_method.shading.color import linear_to_srgb, srgb_to_linear

__all__ = ["ViewPixels", "pixel_colors", "read_colors", "read_mask", "read_view"]

MIN_OBJECT_SHARE = 0.5
"""Smallest share of the area of a reduced pixel that must be on the object."""
ROWS = 256
"""Number of rows of an image that are converted to linear values at once; bounds the memory."""


@dataclass(frozen=True)
class ViewPixels:
    """The pixels of a view.

    Attributes:
        color: linear radiance on the scale that all views share, or display values; finite if `broken` is 0.
        mask: pixels on the object, by the mask file or the alpha channel; None if the view has neither.
        valid: pixels that the validity mask does not exclude; a reduced pixel is valid if all pixels of the
            file that it covers are.
        broken: number of pixels of the file that are NaN, infinite or negative, and not marked as invalid.
    """

    color: Float32[np.ndarray, "H W 3"]
    mask: Bool[np.ndarray, "H W"] | None
    valid: Bool[np.ndarray, "H W"]
    broken: int


def read_view(view: View, hdr: bool) -> ViewPixels:
    """Read the files of a view.

    Raises:
        UserError: a file cannot be read, or does not have the size that it had when the capture was loaded;
            the mask shows no object; or display values have an exposure.
    """
    image = _read(view)
    color = pixel_colors(view, image, hdr).numpy()
    sound = (np.isfinite(color) & (color >= 0)).all(axis=-1)
    usable = np.ones_like(sound) if view.valid is None else read_mask(view.valid, view)
    broken = int((usable & ~sound).sum())
    if not sound.all():
        color = np.where((sound | usable)[..., None], color, np.float32(0.0))
    mask = _object_mask(view, image)
    width, height = view.camera.width, view.camera.height
    if file_size(view) != (width, height):
        color = _scaled(color, hdr, width, height)
        mask = None if mask is None else area_share(mask, width, height) >= MIN_OBJECT_SHARE
        usable = area_share(usable, width, height) > 1 - 1e-6
    return ViewPixels(color, mask, usable, broken)


def read_colors(view: View, hdr: bool) -> Float32[np.ndarray, "H W 3"]:
    """Read only the colours of a view, as `read_view` returns them."""
    color = pixel_colors(view, _read(view), hdr).numpy()
    width, height = view.camera.width, view.camera.height
    return color if file_size(view) == (width, height) else _scaled(color, hdr, width, height)


def pixel_colors(view: View, image: ImageFile, hdr: bool) -> Float32[Tensor, "H W 3"]:
    """Return the pixels of an image at the size of its file, divided by exposure and white balance.

    Raises:
        UserError: the pixels are display values, and the view has an exposure or a white balance.
    """
    color = torch.from_numpy(image.pixels).expand(-1, -1, 3)
    factors = view.exposure * torch.tensor(view.white_balance)
    if (factors == 1.0).all():
        return color
    if not hdr:
        # Values clipped for display stay clipped after the division, so no rendering could match them.
        raise UserError(
            f"{view.image}: an exposure or white balance for display values (sRGB)",
            "develop the images linearly, or use one exposure for all images and leave out the factors",
        )
    return color / factors


def read_mask(path: Path, view: View) -> Bool[np.ndarray, "H W"]:
    """Return where a mask of the view is above one half, at the size of its files."""
    values = read_image(path).mask
    if values.shape[::-1] != file_size(view):
        raise UserError(f"{path}: the mask has another size than {view.image}", "load the capture again")
    return values > 0.5


def _read(view: View) -> ImageFile:
    image = read_image(view.image)
    height, width = image.pixels.shape[:2]
    wanted = file_size(view)
    if (width, height) != wanted:
        raise UserError(
            f"{view.image}: {width}×{height} pixels where the camera has {wanted[0]}×{wanted[1]}",
            "load the capture again",
        )
    return image


def _object_mask(view: View, image: ImageFile) -> Bool[np.ndarray, "H W"] | None:
    """Where the mask file, or else the alpha channel, is above one half; None if there is neither."""
    if view.mask is None and image.alpha is None:
        return None
    mask = read_mask(view.mask, view) if view.mask else image.alpha > 0.5
    if not mask.any():
        raise UserError(
            f"{view.mask or view.image}: the mask shows no object",
            "remove the view, or make the object's pixels white",
        )
    return mask


def _scaled(
    color: Float32[np.ndarray, "H W 3"], hdr: bool, width: int, height: int
) -> Float32[np.ndarray, "h w 3"]:
    """Resize an image by averaging linear radiance."""
    if hdr:
        return area_average(color, width, height)
    linear = np.empty(color.shape, np.float32)
    # Converting a whole photograph at once would take several times its memory.
    for start in range(0, len(color), ROWS):
        rows = slice(start, start + ROWS)
        linear[rows] = srgb_to_linear(torch.from_numpy(np.ascontiguousarray(color[rows]))).numpy()
    return linear_to_srgb(torch.from_numpy(area_average(linear, width, height))).numpy()
