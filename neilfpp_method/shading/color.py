"""What a pixel is of radiance: the sRGB curve, clipping, luminance (METHOD §6)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.errors import UserError

__all__ = [
    "CLIPPED",
    "apply_response",
    "at_common_exposure",
    "linear_to_srgb",
    "luminance",
    "residual",
    "response_slope",
    "srgb_to_linear",
    "tone_map",
]

KNEE = 0.04045
"""The pixel at which the sRGB curve goes over from a line to a power."""
CLIPPED = 0.99
"""Display values from here on may be cut off: they say only that radiance is at least so much. The encoders
of cameras leave clipped areas two or three of 255 levels below white.
"""


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


def residual(
    radiance: Float[Tensor, "*shape"], pixel: Float[Tensor, "*shape"], response: str
) -> Float[Tensor, "*shape"]:
    """What the camera would store of a radiance, were its range endless, less what it stored.

    A display value that may be clipped is a lower bound: there the residual of a brighter radiance is 0, and
    so is its gradient. Elsewhere radiance beyond the camera's range is off by how far it lies beyond, and has
    a gradient that leads back.

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
    """What a camera of gain 1 would have stored, were its range endless, in place of one of another gain.

    A display value that may be clipped stays one, whatever the gain: it remains a lower bound.

    Args:
        pixel: in the capture's response.
        gain: what the camera multiplied radiance by.
        response: "linear" or "srgb".
    """
    if response == "linear":
        return pixel / gain
    common = linear_to_srgb(srgb_to_linear(pixel) / gain)
    return torch.where(pixel >= CLIPPED, common.clamp_min(1), common)


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
