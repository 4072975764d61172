"""Numbers that compare an estimate with the truth: pure functions on arrays.

Image metrics take one view each: views may differ in size, and published tables average over views.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree
from skimage.metrics import structural_similarity

__all__ = [
    "LOG_FLOOR",
    "SSIM_WINDOW",
    "Chamfer",
    "align_gamma",
    "align_scale",
    "angular_error",
    "chamfer",
    "confidence_ratio",
    "log_error",
    "log_ratio",
    "psnr",
    "psnr_frame",
    "sample_surface",
    "ssim",
]

PERFECT = 1e-10
"""Least mean squared error over the squared peak: a perfect estimate scores 100 dB, valid in JSON."""

SSIM_WINDOW = 11
"""Side of the SSIM window, pixels (Wang et al. 2004): Gaussian, σ = 1.5, to 3.5 σ. Least image side."""

LOG_FLOOR = 1e-3
"""Radiance added before a logarithm: true radiance can be 0, and far smaller differences are invisible."""

QUERIES = 20_000
"""Points of one nearest-neighbour query: one of all points is slow where two surfaces are far apart."""


# ----------------------------------------------------------------------------------------------------- images


def psnr(
    estimate: Float[np.ndarray, "H W C"],
    truth: Float[np.ndarray, "H W C"],
    mask: Bool[np.ndarray, "H W"],
    peak: float = 1.0,
) -> float:
    """Peak signal-to-noise ratio of one view over its masked pixels, dB.

    10 log10(peak² / MSE), the squared error averaged over masked pixels and channels; at most 100 dB.
    """
    return _decibels(_squared_error(estimate, truth)[mask].mean(), peak)


def psnr_frame(
    estimate: Float[np.ndarray, "H W C"],
    truth: Float[np.ndarray, "H W C"],
    mask: Bool[np.ndarray, "H W"],
    peak: float = 1.0,
) -> float:
    """As `psnr`, over the whole frame with the background counted as free of error (METHOD §8).

    Higher than the masked figure by 10 log10(all pixels / masked pixels).
    """
    return _decibels((_squared_error(estimate, truth) * mask[..., None]).mean(), peak)


def ssim(
    estimate: Float[np.ndarray, "H W C"], truth: Float[np.ndarray, "H W C"], mask: Bool[np.ndarray, "H W"]
) -> float:
    """Structural similarity of one view, values in [0, 1]: the mean of its map over the masked pixels.

    Windows as in Wang et al. 2004. They reach across the mask's border; what they see there is the truth for
    both, so that the background, which nobody asked for, cannot lower the score.
    """
    pasted = np.where(mask[..., None], estimate, truth)
    _, similarity = structural_similarity(
        pasted,
        truth,
        channel_axis=-1,
        data_range=1.0,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        full=True,
    )
    return float(similarity[mask].mean())


def angular_error(
    estimate: Float[np.ndarray, "H W 3"], truth: Float[np.ndarray, "H W 3"], mask: Bool[np.ndarray, "H W"]
) -> float:
    """Mean angle between normals, degrees, over masked pixels where both are non-zero; NaN without any.

    Normals need not be unit. atan2(‖a × b‖, a · b) keeps its digits at small angles, where acos loses them.
    """
    rows = mask & estimate.any(-1) & truth.any(-1)
    a, b = estimate[rows].astype(np.float64), truth[rows].astype(np.float64)
    angles = np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), (a * b).sum(-1))
    return float(np.degrees(angles).mean()) if len(angles) else float("nan")


def _squared_error(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.square(a.astype(np.float64) - b.astype(np.float64))


def _decibels(squared_error: float, peak: float) -> float:
    return float(-10.0 * np.log10(max(squared_error / peak**2, PERFECT)))


# -------------------------------------------------------------------------------------------------- alignment


def align_gamma(estimate: Float[np.ndarray, "P C"], truth: Float[np.ndarray, "P C"]) -> float:
    """The exponent γ for which estimate^γ has the truth's median: ln(median truth) / ln(median estimate).

    One number for all channels and pixels, as in the paper's published code. Medians are held off 0 and 1,
    where the quotient has no value.
    """
    medians = np.clip([np.median(truth), np.median(estimate)], 1e-3, 1.0 - 1e-3)
    return float(np.log(medians[0]) / np.log(medians[1]))


def align_scale(
    estimate: Float[np.ndarray, "P C"], truth: Float[np.ndarray, "P C"]
) -> Float[np.ndarray, " C"]:
    """The factor per channel that brings the estimate closest to the truth, in least squares (Stanford-ORB):
    Σet / Σe².

    1 for a channel whose estimate is zero throughout.
    """
    e, t = estimate.astype(np.float64), truth.astype(np.float64)
    energy = (e * e).sum(0)
    return np.divide((e * t).sum(0), energy, out=np.ones_like(energy), where=energy > 0)


# --------------------------------------------------------------------------------------------------- geometry


@dataclass(frozen=True)
class Chamfer:
    """Mean distances between two surfaces, in the unit of their points.

    `accuracy` is from estimate to truth, `completeness` from truth to estimate, `mean` half their sum.
    """

    accuracy: float
    completeness: float

    @property
    def mean(self) -> float:
        return 0.5 * (self.accuracy + self.completeness)


def chamfer(estimate: Float[np.ndarray, "P 3"], truth: Float[np.ndarray, "Q 3"]) -> Chamfer:
    """Distances from the points of each surface to the nearest point of the other.

    All points are there to be found, but of a large set only every k-th looks for its neighbour, fewer than
    twice `QUERIES` of them: dense sets keep the distance between samples small, and the mean needs no more
    terms.
    """
    return Chamfer(_mean_distance(estimate, truth), _mean_distance(truth, estimate))


def _mean_distance(points: Float[np.ndarray, "P 3"], surface: Float[np.ndarray, "Q 3"]) -> float:
    asking = points[:: max(1, len(points) // QUERIES)]
    return float(cKDTree(surface).query(asking)[0].mean())


def sample_surface(mesh: trimesh.Trimesh, count: int, seed: int = 0) -> Float[np.ndarray, "count 3"]:
    """Points spread evenly over the area of a mesh; the same ones for the same seed."""
    points, _ = trimesh.sample.sample_surface(mesh, count, seed=seed)
    return np.asarray(points, dtype=np.float64)


# ------------------------------------------------------------------------------------------------------ light


def log_ratio(
    estimate: Float[np.ndarray, "P C"], truth: Float[np.ndarray, "P C"]
) -> Float[np.ndarray, "P C"]:
    """ln(estimate + LOG_FLOOR) − ln(truth + LOG_FLOOR): radiance spans orders of magnitude."""
    return np.log(estimate.astype(np.float64) + LOG_FLOOR) - np.log(truth.astype(np.float64) + LOG_FLOOR)


def log_error(ratio: Float[np.ndarray, "P C"]) -> float:
    """Mean absolute log ratio; 0.69 is a factor of two."""
    return float(np.abs(ratio).mean())


# ------------------------------------------------------------------------------------------------- confidence


def confidence_ratio(error: Float[np.ndarray, " P"], expected: Float[np.ndarray, " P"]) -> float | None:
    """Mean error of the half with the smallest expected error over that of the other; none if that is 0."""
    order = np.argsort(expected, kind="stable")
    sure, unsure = np.split(error[order], [len(order) // 2])
    return float(sure.mean() / unsure.mean()) if len(sure) and unsure.mean() > 0 else None
