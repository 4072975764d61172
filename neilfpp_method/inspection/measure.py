"""Measure one view: brightness, sharpness, clipping and more. `defects` judges these figures."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float32

from neilfpp_method.data.files.images import ImageFile, read_image
from neilfpp_method.data.hulls.silhouettes import Outline, outline_of
from neilfpp_method.data.pixels.object_source import ObjectSource
from neilfpp_method.data.pixels.store import BORDER_SHARE
from neilfpp_method.data.pixels.view_pixels import pixel_colors, read_mask
from neilfpp_method.data.views import View
from neilfpp_method.errors import UserError
from neilfpp_method.shading.color import linear_to_srgb, luminance, srgb_to_linear

__all__ = ["ViewFigures", "measure"]

THUMBNAIL_SIDE = 160
"""Longest side of the thumbnail of a view, in pixels."""
SHARPNESS_SIDE = 1600
"""Longest side at which sharpness is measured, in pixels; finer detail is blurred by demosaicing."""
MIDDLE_GRAY = 0.18
"""Linear value to which the luminance of the object is scaled before sharpness is measured."""
DARK = 1e-3
"""Luminance below which a pixel counts as black, relative to the mean of the object."""
CLIPPED_VALUE = 254.5 / 255
"""Display value from which a pixel counts as clipped."""
PLATEAU_WIDTH = 1e-4
"""Relative distance from the maximum of a linear image within which a pixel counts as at the maximum."""
MIN_CLIPPED = 16
"""Smallest number of pixels at the maximum of a linear image that counts as clipping."""
LEVEL_SAMPLES = 200_000
"""Number of pixels, up to a factor of two, from which the distinct levels are counted."""


@dataclass(frozen=True)
class ViewFigures:
    """Figures of a view. Shares refer to the pixels of the object unless stated otherwise.

    The object is known from the mask, the alpha channel or a background of a single colour; otherwise all
    pixels count as the object.

    Attributes:
        name: name of the view.
        unreadable: the reason if the pixels cannot be read, in which case all other figures are 0; else
            empty.
        luminance: geometric mean of the linear luminance of the object, on the scale that all views share; 0
            for a black image. Unlike the median, it changes little if the share of sky changes in images that
            are half sky and half ground.
        stops: ratio of the 99.9th to the 1st percentile of that luminance, in powers of two.
        sharpness: variance of the Laplacian divided by the variance of the picture, after all views have been
            scaled to one brightness.
        clipped: share of pixels that in any channel are at 255 (display values), or at a maximum at which the
            values of an HDR image accumulate.
        invalid: share of all pixels that the validity mask excludes.
        broken: share of all pixels that are NaN, infinite or negative and not marked as invalid.
        pixels: number of the object's pixels that are valid.
        levels: number of distinct values among up to 400,000 pixels of the object, in the channel with the
            most.
        object_from: what shows which pixels are the object; "nothing": all pixels count as the object.
        outline: the mask file or the alpha channel, at most 160 pixels a side; None if there is neither.
        small: thumbnail in linear radiance, at most 160 pixels a side.
    """

    name: str
    unreadable: str = ""
    luminance: float = 0.0
    stops: float = 0.0
    sharpness: float = 0.0
    clipped: float = 0.0
    invalid: float = 0.0
    broken: float = 0.0
    pixels: int = 0
    levels: int = 0
    object_from: ObjectSource = "nothing"
    outline: Outline | None = field(default=None, repr=False)
    small: Float32[np.ndarray, "h w 3"] = field(
        default_factory=lambda: np.zeros((1, 1, 3), np.float32), repr=False
    )


def measure(view: View, hdr: bool) -> ViewFigures:
    """Measure a view. If its image cannot be read, the reason is returned in `ViewFigures.unreadable`."""
    try:
        image = read_image(view.image)
        color = pixel_colors(view, image, hdr).numpy()
        valid = np.ones(color.shape[:2], bool) if view.valid is None else read_mask(view.valid, view)
        mask = None if view.mask is None else read_mask(view.mask, view)
    except UserError as error:
        return ViewFigures(view.name, unreadable=error.problem)
    sound = (np.isfinite(color) & (color >= 0)).all(axis=-1)
    usable = sound & valid
    source: ObjectSource = "mask file"
    if mask is None and image.alpha is not None:
        mask, source = image.alpha > 0.5, "alpha channel"
    outline = None if mask is None else outline_of(view, mask, THUMBNAIL_SIDE)
    if mask is None:
        mask = _off_the_background(color, usable)
        source = "nothing" if mask is None else "background of one colour"
    chosen = usable if mask is None else usable & mask
    color = np.where(sound[..., None], color, np.float32(0.0))
    linear = color if hdr else srgb_to_linear(torch.from_numpy(color)).numpy()
    light = luminance(torch.from_numpy(linear)).numpy()
    bright = light[chosen & (light > DARK * light[chosen].mean())] if chosen.any() else light[chosen]
    low, high = np.percentile(bright, [1, 99.9]) if bright.size else (1.0, 1.0)
    typical = float(np.exp(np.log(bright).mean(dtype=np.float64))) if bright.size else 0.0
    return ViewFigures(
        name=view.name,
        luminance=typical,
        stops=float(np.log2(high / low)),
        sharpness=_sharpness(light, chosen, typical),
        clipped=_clipped(image, color, chosen),
        invalid=float(1.0 - valid.mean()),
        broken=float((valid & ~sound).mean()),
        pixels=int(chosen.sum()),
        levels=_levels(color[chosen]),
        object_from=source,
        outline=outline,
        small=_fitted(linear, THUMBNAIL_SIDE),
    )


def _off_the_background(
    color: Float32[np.ndarray, "H W 3"], usable: Bool[np.ndarray, "H W"]
) -> Bool[np.ndarray, "H W"] | None:
    """Pixels that do not have the colour of most border pixels; None if there is no such colour."""
    edge = np.zeros(usable.shape, bool)
    edge[[0, -1]] = edge[:, [0, -1]] = True
    border = color[edge & usable]
    if not len(border):
        return None
    common = np.median(border, axis=0)
    even = (border == common).all(axis=-1).mean() >= BORDER_SHARE
    return ~(color == common).all(axis=-1) if even else None


def _sharpness(light: Float32[np.ndarray, "H W"], chosen: Bool[np.ndarray, "H W"], typical: float) -> float:
    if typical <= 0:
        return 0.0
    gray = linear_to_srgb(torch.from_numpy(light * np.float32(MIDDLE_GRAY / typical)).clamp(0, 1)).numpy()
    gray, on_object = (
        _fitted(gray, SHARPNESS_SIDE),
        _fitted(chosen.astype(np.float32), SHARPNESS_SIDE) > 0.5,
    )
    if not on_object.any():
        return 0.0
    spread = float(gray[on_object].var())
    return float(cv2.Laplacian(gray, cv2.CV_32F)[on_object].var()) / spread if spread > 0 else 0.0


def _clipped(image: ImageFile, color: Float32[np.ndarray, "H W 3"], chosen: Bool[np.ndarray, "H W"]) -> float:
    pixels = color[chosen]
    if not len(pixels):
        return 0.0
    if not image.hdr:
        return float((image.pixels[chosen] >= CLIPPED_VALUE).any(axis=-1).mean())
    # Clipping of a sensor gives many pixels the same level; without it, few pixels share the maximum.
    top = pixels >= pixels.max(axis=0) * (1 - PLATEAU_WIDTH)
    piled = (top.sum(axis=0) >= MIN_CLIPPED) & (pixels.max(axis=0) > pixels.min(axis=0))
    return float((top & piled).any(axis=-1).mean())


def _levels(pixels: Float32[np.ndarray, "N 3"]) -> int:
    some = pixels[:: max(1, len(pixels) // LEVEL_SAMPLES)]
    return max(len(np.unique(channel)) for channel in some.T)


def _fitted(values: Float32[np.ndarray, "H W *C"], side: int) -> Float32[np.ndarray, "h w *C"]:
    height, width = values.shape[:2]
    share = side / max(height, width)
    if share >= 1:
        return values
    size = max(1, round(width * share)), max(1, round(height * share))
    return cv2.resize(values, size, interpolation=cv2.INTER_AREA)
