"""What a pixel is of radiance: the sRGB curve, clipping, luminance (METHOD §6)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.errors import UserError

__all__ = ["apply_response", "linear_to_srgb", "luminance", "response_slope", "srgb_to_linear", "tone_map"]

KNEE = 0.04045
"""The pixel at which the sRGB curve goes over from a line to a power."""


def linear_to_srgb(color: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """The sRGB curve (IEC 61966-2-1): 12.92 c up to 0.0031308, then 1.055 c^(1/2.4) − 0.055.

    Nothing is clipped: the linear part extends below 0, the power above 1, gradients are finite.
    """
    knee = 0.0031308
    return torch.where(color <= knee, 12.92 * color, 1.055 * color.clamp_min(knee).pow(1 / 2.4) - 0.055)


def srgb_to_linear(color: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """The inverse of `linear_to_srgb`: c/12.92 up to 0.04045, then ((c + 0.055)/1.055)^2.4."""
    return torch.where(color <= KNEE, color / 12.92, ((color.clamp_min(KNEE) + 0.055) / 1.055).pow(2.4))


def tone_map(color: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Linear radiance as an 8-bit display would show it: clipped to [0, 1], then the sRGB curve."""
    return linear_to_srgb(color.clamp(0, 1))


def apply_response(color: Float[Tensor, "*shape"], response: str) -> Float[Tensor, "*shape"]:
    """What the camera stores of linear radiance: the same (HDR), or clipped and sRGB-encoded (LDR).

    Raises:
        UserError: the response is neither; "auto" must be settled by the capture first.
    """
    if response == "linear":
        return color
    if response == "srgb":
        return tone_map(color)
    raise UserError(f"unknown response '{response}'", "choose linear or srgb")


def response_slope(pixel: Float[Tensor, "*shape"], response: str) -> Float[Tensor, "*shape"]:
    """What a pixel changes by per unit of the logarithm of radiance, dp / d ln c: an error over this is one
    of radiance, relative, whatever the camera stores. The pixel itself (HDR); along the power of the sRGB
    curve (p + 0.055) / 2.4.
    """
    if response == "linear":
        return pixel
    return torch.where(pixel <= KNEE, pixel, (pixel + 0.055) / 2.4)


def luminance(color: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
    """Relative luminance of linear RGB with the primaries of Rec. 709: 0.2126 R + 0.7152 G + 0.0722 B."""
    red, green, blue = color.unbind(-1)
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue
