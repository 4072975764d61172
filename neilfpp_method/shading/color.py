"""Responses of cameras: the sRGB curve, clipping, and luminance (METHOD §6)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.errors import UserError

__all__ = [
    "CLIPPED",
    "apply_response",
    "at_common_exposure",
    "display_values",
    "linear_to_srgb",
    "luminance",
    "residual",
    "response_slope",
    "srgb_to_linear",
    "tone_map",
]

KNEE = 0.04045
"""Display value at which the sRGB curve changes from a linear function to a power."""
CLIPPED = 0.99
"""Display value from which a pixel may be clipped, so that it is only a lower bound on the radiance. Cameras
encode clipped areas up to two or three of 255 levels below white.
"""


def linear_to_srgb(color: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """The sRGB curve (IEC 61966-2-1): 12.92 c up to 0.0031308, then 1.055 c^(1/2.4) − 0.055.

    Values are not clipped: the linear part extends below 0 and the power above 1. Gradients are finite.
    """
    knee = 0.0031308
    return torch.where(color <= knee, 12.92 * color, 1.055 * color.clamp_min(knee).pow(1 / 2.4) - 0.055)


def srgb_to_linear(color: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """The inverse of `linear_to_srgb`: c/12.92 up to 0.04045, then ((c + 0.055)/1.055)^2.4."""
    return torch.where(color <= KNEE, color / 12.92, ((color.clamp_min(KNEE) + 0.055) / 1.055).pow(2.4))


def tone_map(color: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Display values of linear radiance: clipped to [0, 1], then sRGB-encoded."""
    return linear_to_srgb(color.clamp(0, 1))


def apply_response(color: Float[Tensor, "*shape"], response: str) -> Float[Tensor, "*shape"]:
    """Pixel values of linear radiance: unchanged ("linear", HDR), or clipped and sRGB-encoded ("srgb", LDR).

    Raises:
        UserError: the response is neither; "auto" must be resolved by the capture first.
    """
    if response == "linear":
        return color
    if response == "srgb":
        return tone_map(color)
    raise UserError(f"unknown response '{response}'", "choose linear or srgb")


def display_values(pixel: Float[Tensor, "*shape"], response: str) -> Float[Tensor, "*shape"]:
    """Display values of pixels in a response: linear pixels are tone-mapped, display values only clipped."""
    return tone_map(pixel) if response == "linear" else pixel.clamp(0, 1)


def residual(
    radiance: Float[Tensor, "*shape"], pixel: Float[Tensor, "*shape"], response: str
) -> Float[Tensor, "*shape"]:
    """Difference between the pixel value of a radiance, encoded without clipping, and the pixel.

    A pixel that may be clipped (≥ `CLIPPED`, srgb) is a lower bound: for a brighter radiance the residual and
    its gradient are 0. For other pixels radiance beyond the camera's range has a residual and a gradient.

    Example:
        >>> residual(torch.tensor([4.0, 1.0]), torch.tensor([1.0, 0.5]), "srgb")
        tensor([0.0000, 0.5000])
    """
    if response == "linear":
        return radiance - pixel
    off = linear_to_srgb(radiance.clamp_min(0)) - pixel
    return torch.where(pixel >= CLIPPED, off.clamp_max(0), off)


def at_common_exposure(
    pixel: Float[Tensor, "*shape"], gain: Float[Tensor, "#*shape"], response: str
) -> Float[Tensor, "*shape"]:
    """Convert pixels of a camera with some gain to those of a camera with gain 1, without clipping.

    A pixel that may be clipped still counts as clipped after the conversion, so it remains a lower bound. So
    does a highlight of an underexposed photograph that is beyond the range of a camera with gain 1, although
    it was not clipped: pixels have no flag, and as a lower bound its value is right as well.

    Args:
        pixel: pixel values in the capture's response.
        gain: factor by which the camera multiplied radiance.
        response: "linear" or "srgb".
    """
    if response == "linear":
        return pixel / gain
    common = linear_to_srgb(srgb_to_linear(pixel) / gain)
    return torch.where(pixel >= CLIPPED, common.clamp_min(1), common)


def response_slope(pixel: Float[Tensor, "*shape"], response: str) -> Float[Tensor, "*shape"]:
    """Derivative of a pixel value with respect to log radiance, dp / d ln c.

    An error of a pixel divided by it is a relative error of radiance, for every response. It is p for a
    linear pixel p, and (p + 0.055) / 2.4 on the power part of the sRGB curve.
    """
    if response == "linear":
        return pixel
    return torch.where(pixel <= KNEE, pixel, (pixel + 0.055) / 2.4)


def luminance(color: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
    """Relative luminance of linear RGB with the primaries of Rec. 709: 0.2126 R + 0.7152 G + 0.0722 B."""
    red, green, blue = color.unbind(-1)
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue
