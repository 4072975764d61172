"""The pixels of one view as its files hold them, at the size of its camera: colours, mask and validity."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float32
from torch import Tensor

from neilfpp_method.data.images import ImageFile, read_image
from neilfpp_method.data.scaling import area_average, area_share, file_size
from neilfpp_method.data.views import View
from neilfpp_method.errors import UserError
from neilfpp_method.shading.color import linear_to_srgb, srgb_to_linear

__all__ = ["ViewPixels", "pixel_colors", "read_colors", "read_mask", "read_view"]

HALF = 0.5
"""Share of the area of a reduced pixel that must be on the object."""
ROWS = 256
"""Rows of an image that are made linear together: bounds the memory."""


@dataclass(frozen=True)
class ViewPixels:
    """What a view's files say of its pixels.

    Attributes:
        color: linear radiance on the scale that the views share, or display values; finite where nothing is
            `broken`.
        mask: where the object is, by the mask file or the alpha channel; none where the view has neither.
        valid: all but those that the validity mask leaves out; a pixel that covers several is valid where all
            of them are.
        broken: number of pixels of the file that are NaN, infinite or negative, and not marked as invalid.
    """

    color: Float32[np.ndarray, "H W 3"]
    mask: Bool[np.ndarray, "H W"] | None
    valid: Bool[np.ndarray, "H W"]
    broken: int


def read_view(view: View, hdr: bool) -> ViewPixels:
    """Read the files of a view.

    Raises:
        UserError: a file cannot be read, or has another size than when the capture was loaded; the mask shows
            no object; or display values have an exposure.
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
        mask = None if mask is None else area_share(mask, width, height) >= HALF
        usable = area_share(usable, width, height) > 1 - 1e-6
    return ViewPixels(color, mask, usable, broken)


def read_colors(view: View, hdr: bool) -> Float32[np.ndarray, "H W 3"]:
    """The colours of a view alone, as `read_view` has them."""
    color = pixel_colors(view, _read(view), hdr).numpy()
    width, height = view.camera.width, view.camera.height
    return color if file_size(view) == (width, height) else _scaled(color, hdr, width, height)


def pixel_colors(view: View, image: ImageFile, hdr: bool) -> Float32[Tensor, "H W 3"]:
    """The pixels of a view's image at its own size; linear images keep neither exposure nor white balance.

    Raises:
        UserError: display values with an exposure or a white balance.
    """
    color = torch.from_numpy(image.pixels).expand(-1, -1, 3)
    factors = view.exposure * torch.tensor(view.white_balance)
    if (factors == 1.0).all():
        return color
    if not hdr:
        # Values clipped for display stay clipped at any exposure: no render compares with the quotient.
        raise UserError(
            f"{view.image}: an exposure or white balance for display values (sRGB)",
            "develop the images linearly, or expose them all alike and leave out the factors",
        )
    return color / factors


def read_mask(path: Path, view: View) -> Bool[np.ndarray, "H W"]:
    """Where a mask of the view, at the size of its files, is above one half."""
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
    """The object: where the mask file, or else the image's alpha, is above one half; none without either."""
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
    """Averaged in linear radiance."""
    if hdr:
        return area_average(color, width, height)
    linear = np.empty(color.shape, np.float32)
    for start in range(0, len(color), ROWS):  # a power of a whole photograph would take several of its size
        rows = slice(start, start + ROWS)
        linear[rows] = srgb_to_linear(torch.from_numpy(np.ascontiguousarray(color[rows]))).numpy()
    return linear_to_srgb(torch.from_numpy(area_average(linear, width, height))).numpy()
