"""Exposure brackets, photographs of one pose at several exposures, merged into linear radiance.

The camera's response is known (linear, sRGB) or calibrated by OpenCV's implementation of Debevec and Malik
(SIGGRAPH 1997). The merge is our own: OpenCV's takes 8 bits a pixel alone, and does not say what is clipped
at every exposure.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float32

from neilfpp_method.errors import UserError
from neilfpp_method.shading.color import srgb_to_linear

__all__ = ["Bracket", "Merged", "Response", "calibrate", "linear_response", "merge", "srgb_response"]

Response = Callable[[Float32[np.ndarray, "H W 3"]], Float32[np.ndarray, "H W 3"]]
"""From pixels in [0, 1] to the light that they took in, up to one factor."""

MIN_VALUE, MAX_VALUE = 4 / 255, 250 / 255
"""Encoded values that are used; outside them a pixel is too dark or clipped."""
SAMPLES_SIDE = 16
"""Pixels per side of the grid that the response is calibrated from."""
SMOOTHNESS = 30.0
"""Weight of the response's smoothness; OpenCV's default, 10, follows errors of hand-held photographs."""
NOISE = 3
"""Levels of 255 by which a longer exposure may be darker than a shorter one."""


@dataclass(frozen=True)
class Bracket:
    """Pixels of one pose, in [0, 1], and the exposure of each image."""

    pixels: tuple[Float32[np.ndarray, "H W 3"], ...]
    exposures: tuple[float, ...]


@dataclass(frozen=True)
class Merged:
    """Linear radiance, and where it is known: a pixel clipped at every exposure holds only a lower bound."""

    radiance: Float32[np.ndarray, "H W 3"]
    valid: Bool[np.ndarray, "H W"]


# --------------------------------------------------------------------------------------------------- response


def linear_response(pixels: Float32[np.ndarray, "H W 3"]) -> Float32[np.ndarray, "H W 3"]:
    """Pixels that are proportional to light."""
    return pixels


def srgb_response(pixels: Float32[np.ndarray, "H W 3"]) -> Float32[np.ndarray, "H W 3"]:
    """Pixels that an sRGB curve has encoded."""
    return srgb_to_linear(torch.from_numpy(pixels)).numpy()


def calibrate(brackets: Sequence[Bracket]) -> Response:
    """The response of the camera that took brackets, all at the same exposures, with 8 bits a pixel.

    Debevec and Malik's linear system for 256 pixels, whose sums over the exposures are evenly spaced: so all
    levels of light count alike, whatever fills most of the picture. Pixels that a longer exposure shows
    darker are left out, unless most are: there something moved, or an image that was aligned shows nothing.

    Raises:
        UserError: the images do not determine a response that increases.
    """
    stacks = [
        np.stack([np.rint(255 * image).reshape(-1, 3) for image in bracket.pixels]) for bracket in brackets
    ]
    levels = np.concatenate(stacks, axis=1).astype(np.uint8)
    more = np.diff(levels[np.argsort(brackets[0].exposures)].astype(np.int16), axis=0)
    lighter = (more >= -NOISE).all(axis=(0, 2))
    if lighter.mean() > 0.5:
        levels = levels[:, lighter]
    total = levels.sum(axis=(0, 2), dtype=np.int64)
    order = np.argsort(total, kind="stable")
    wanted = np.linspace(total[order[0]], total[order[-1]], SAMPLES_SIDE**2)
    chosen = order[np.searchsorted(total[order], wanted)]
    samples = [np.ascontiguousarray(image[chosen].reshape(SAMPLES_SIDE, SAMPLES_SIDE, 3)) for image in levels]
    times = np.array(brackets[0].exposures, dtype=np.float32)
    curve = cv2.createCalibrateDebevec(SAMPLES_SIDE**2, SMOOTHNESS).process(samples, times).reshape(256, 3)
    inner = curve[round(255 * MIN_VALUE) : round(255 * MAX_VALUE) : 16]
    if not np.isfinite(curve).all() or (np.diff(inner, axis=0) <= 0).any():
        raise UserError(
            "the camera's response cannot be told from these brackets: it would not increase",
            "use three or more exposures a stop or two apart, or give the response (linear or srgb)",
        )
    level = np.linspace(0.0, 1.0, 256)

    def response(pixels: Float32[np.ndarray, "H W 3"]) -> Float32[np.ndarray, "H W 3"]:
        channels = [np.interp(pixels[..., c], level, curve[:, c]) for c in range(3)]
        return np.stack(channels, axis=-1).astype(np.float32)

    return response


# ------------------------------------------------------------------------------------------------------ merge


def merge(bracket: Bracket, response: Response) -> Merged:
    """Radiance E = Σ w f(z)/t / Σ w over the exposures t, per channel, in the unit of f per unit of t.

    w = t · max(min(z − z₀, z₁ − z), 0): photon noise makes the variance of f(z)/t proportional to 1/t, and
    values fade out towards both ends of the range. A channel that is dark at every exposure takes its value
    from the longest, whose error is small as an amount of light; one that is clipped at every exposure takes
    the shortest's, and the pixel is invalid. 1, a clipped value, also stands for what an image does not show.
    """
    first, *_ = order = np.argsort(bracket.exposures)
    total = np.zeros_like(bracket.pixels[0])
    weights, fallback = total.copy(), total.copy()
    for i in order:
        z, t = bracket.pixels[i], np.float32(bracket.exposures[i])
        estimate = response(z) / t
        fallback = np.where((z < MAX_VALUE) | (i == first), estimate, fallback)
        weight = t * np.minimum(z - MIN_VALUE, MAX_VALUE - z).clip(0)
        total += weight * estimate
        weights += weight
    known = weights > 0
    radiance = np.where(known, total / np.where(known, weights, 1), fallback)
    return Merged(radiance.astype(np.float32), (np.min(bracket.pixels, axis=0) < MAX_VALUE).all(axis=-1))
