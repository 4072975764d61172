"""Merge exposure brackets, photographs of one pose at several exposures, into linear radiance.

The camera's response is known (linear, sRGB) or calibrated by OpenCV's implementation of Debevec and Malik
(SIGGRAPH 1997). OpenCV's merge is not used, because it takes 8-bit images only and does not report which
pixels are clipped at every exposure.
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
"""Function from pixel values in [0, 1] to exposure (radiance times time), up to a constant factor."""

MIN_VALUE, MAX_VALUE = 4 / 255, 250 / 255
"""Range of encoded values that are used; outside it a pixel is too dark or clipped."""
SAMPLES_SIDE = 16
"""Side of the square of sampled pixels from which the response is calibrated."""
SMOOTHNESS = 30.0
"""Weight of the smoothness of the response; OpenCV's default of 10 overfits errors of hand-held brackets."""
NOISE_LEVELS = 3
"""Largest amount, in 8-bit levels, by which noise may make a longer exposure darker than a shorter one."""


@dataclass(frozen=True)
class Bracket:
    """Images of one pose, with values in [0, 1], and the exposure of each image."""

    pixels: tuple[Float32[np.ndarray, "H W 3"], ...]
    exposures: tuple[float, ...]


@dataclass(frozen=True)
class Merged:
    """Linear radiance, and where it is valid: a pixel that is clipped at every exposure is a lower bound."""

    radiance: Float32[np.ndarray, "H W 3"]
    valid: Bool[np.ndarray, "H W"]


# --------------------------------------------------------------------------------------------------- response


def linear_response(pixels: Float32[np.ndarray, "H W 3"]) -> Float32[np.ndarray, "H W 3"]:
    """Response of pixels that are proportional to radiance."""
    return pixels


def srgb_response(pixels: Float32[np.ndarray, "H W 3"]) -> Float32[np.ndarray, "H W 3"]:
    """Response of pixels that are encoded with the sRGB curve."""
    return srgb_to_linear(torch.from_numpy(pixels)).numpy()


def calibrate(brackets: Sequence[Bracket]) -> Response:
    """Calibrate the response of a camera from 8-bit brackets that all have the same exposures.

    The linear system of Debevec and Malik is solved for 256 pixels, whose sums over the exposures are evenly
    spaced, so that all brightness levels have the same weight. Pixels that are darker in a longer exposure
    are left out unless they are the majority: something moved there, or an aligned image has no data.

    Raises:
        UserError: the images do not determine a response that increases.
    """
    stacks = [
        np.stack([np.rint(255 * image).reshape(-1, 3) for image in bracket.pixels]) for bracket in brackets
    ]
    levels = np.concatenate(stacks, axis=1).astype(np.uint8)
    more = np.diff(levels[np.argsort(brackets[0].exposures)].astype(np.int16), axis=0)
    lighter = (more >= -NOISE_LEVELS).all(axis=(0, 2))
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
            "the camera's response cannot be calibrated from these brackets: it would not increase",
            "use three or more exposures a stop or two apart, or give the response (linear or srgb)",
        )
    level = np.linspace(0.0, 1.0, 256)

    def response(pixels: Float32[np.ndarray, "H W 3"]) -> Float32[np.ndarray, "H W 3"]:
        channels = [np.interp(pixels[..., c], level, curve[:, c]) for c in range(3)]
        return np.stack(channels, axis=-1).astype(np.float32)

    return response


# ------------------------------------------------------------------------------------------------------ merge


def merge(bracket: Bracket, response: Response) -> Merged:
    """Compute radiance E = Σ w f(z)/t / Σ w over the exposures t, per channel.

    The unit of E is that of the response f per unit of t.

    The weight is w = t · max(min(z − z₀, z₁ − z), 0), because photon noise makes the variance of f(z)/t
    proportional to 1/t, and values near both ends of the range are unreliable. A channel that is dark at
    every exposure takes the value of the longest exposure, whose absolute error is small. A channel that is
    clipped at every exposure takes the value of the shortest one, and the pixel is invalid. The value 1,
    which is clipped, also marks pixels that an image does not show.
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
