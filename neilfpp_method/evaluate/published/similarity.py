"""Structural similarity (SSIM) with the window and border that published evaluations differ in."""

from __future__ import annotations

from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.ndimage import correlate1d

__all__ = ["ssim_map"]

SIGMA = 1.5
"""Standard deviation of the Gaussian window, pixels (Wang et al. 2004)."""
C1, C2 = 0.01**2, 0.03**2
"""Constants of SSIM for values in [0, 1] (Wang et al. 2004)."""


def ssim_map(
    estimate: Float[np.ndarray, "H W C"],
    truth: Float[np.ndarray, "H W C"],
    window: int = 11,
    border: Literal["zero", "mirror"] = "zero",
) -> Float[np.ndarray, "H W C"]:
    """Compute the SSIM of every pixel and channel of images with values in [0, 1] (Wang et al. 2004).

    Args:
        estimate: the estimate.
        truth: the truth.
        window: width of the Gaussian window, pixels.
        border: how images continue beyond their border: as 0, or mirrored at the outermost pixels.
    """
    offset = np.arange(window) - (window - 1) / 2
    weight = np.exp(-0.5 * (offset / SIGMA) ** 2)
    weight /= weight.sum()
    mode = "constant" if border == "zero" else "mirror"

    def mean(values: np.ndarray) -> np.ndarray:
        return correlate1d(correlate1d(values, weight, 0, mode=mode), weight, 1, mode=mode)

    a, b = estimate.astype(np.float64), truth.astype(np.float64)
    mean_a, mean_b = mean(a), mean(b)
    variances = mean(a * a) - mean_a**2 + mean(b * b) - mean_b**2
    covariance = mean(a * b) - mean_a * mean_b
    luminance = (2 * mean_a * mean_b + C1) / (mean_a**2 + mean_b**2 + C1)
    return luminance * (2 * covariance + C2) / (variances + C2)
