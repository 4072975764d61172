"""Metrics that compare an estimate with the truth: pure functions on arrays.

Image metrics take one view each, because views may differ in size and published tables average over views.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from jaxtyping import Bool, Float
from skimage.metrics import structural_similarity

from neilfpp_method.data.kd_tree import kd_tree

__all__ = [
    "LOG_FLOOR",
    "SSIM_WINDOW",
    "Chamfer",
    "align_gamma",
    "align_scale",
    "angular_error",
    "chamfer",
    "confidence_ratio",
    "decibels",
    "log_error",
    "log_ratio",
    "median_scale",
    "psnr",
    "psnr_frame",
    "sample_surface",
    "ssim",
]

MIN_RELATIVE_ERROR = 1e-10
"""Lower bound of mean squared error over squared peak. A perfect estimate then scores 100 dB instead of
infinity, which JSON cannot hold.
"""

SSIM_WINDOW = 11
"""Side of the SSIM window, pixels (Wang et al. 2004): Gaussian with σ = 1.5, cut off at 3.5 σ. It is also the
least side of an image.
"""

LOG_FLOOR = 1e-3
"""Radiance added before a logarithm, because true radiance can be 0 and much smaller values are invisible."""

QUERIES = 20_000
"""Number of nearest-neighbour queries per surface, up to a factor of 2. A query of every point takes long if
two surfaces are far apart.
"""


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
    return decibels(_squared_error(estimate, truth)[mask].mean(), peak)


def psnr_frame(
    estimate: Float[np.ndarray, "H W C"],
    truth: Float[np.ndarray, "H W C"],
    mask: Bool[np.ndarray, "H W"],
    peak: float = 1.0,
) -> float:
    """Peak signal-to-noise ratio over the whole frame, with the background counted as free of error, dB.

    It exceeds `psnr` by 10 log10(all pixels / masked pixels), up to the limit of 100 dB.
    """
    return decibels((_squared_error(estimate, truth) * mask[..., None]).mean(), peak)


def ssim(
    estimate: Float[np.ndarray, "H W C"], truth: Float[np.ndarray, "H W C"], mask: Bool[np.ndarray, "H W"]
) -> float:
    """Structural similarity of one view with values in [0, 1], averaged over the masked pixels.

    The window is that of Wang et al. 2004. Outside of the mask the estimate is replaced by the truth, so that
    windows which reach across the border of the mask are not affected by the background.
    """
    composited = np.where(mask[..., None], estimate, truth)
    _, similarity = structural_similarity(
        composited,
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
    """Mean angle between normals over masked pixels at which both are non-zero, degrees; NaN if none is.

    Normals need not have unit length. The angle is atan2(‖a × b‖, a · b), which is accurate at small angles;
    acos is not.
    """
    rows = mask & estimate.any(-1) & truth.any(-1)
    a, b = estimate[rows].astype(np.float64), truth[rows].astype(np.float64)
    angles = np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), (a * b).sum(-1))
    return float(np.degrees(angles).mean()) if len(angles) else float("nan")


def _squared_error(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.square(a.astype(np.float64) - b.astype(np.float64))


def decibels(squared_error: float, peak: float = 1.0) -> float:
    """Peak signal-to-noise ratio of a mean squared error, dB; at most 100 dB."""
    return float(-10.0 * np.log10(max(squared_error / peak**2, MIN_RELATIVE_ERROR)))


# -------------------------------------------------------------------------------------------------- alignment


def align_gamma(estimate: Float[np.ndarray, "P C"], truth: Float[np.ndarray, "P C"]) -> float:
    """The exponent γ for which estimate^γ has the truth's median: ln(median truth) / ln(median estimate).

    One number for all channels and pixels, as in the paper's published code. Medians are clamped to
    [0.001, 0.999], because the quotient is undefined at 0 and 1.
    """
    medians = np.clip([np.median(truth), np.median(estimate)], 1e-3, 1.0 - 1e-3)
    return float(np.log(medians[0]) / np.log(medians[1]))


def align_scale(
    estimate: Float[np.ndarray, "P C"], truth: Float[np.ndarray, "P C"]
) -> Float[np.ndarray, " C"]:
    """The least-squares factor per channel from estimate to truth, Σet / Σe² (Stanford-ORB).

    The factor is 1 for a channel whose estimate is zero everywhere.
    """
    e, t = estimate.astype(np.float64), truth.astype(np.float64)
    energy = (e * e).sum(0)
    return np.divide((e * t).sum(0), energy, out=np.ones_like(energy), where=energy > 0)


def median_scale(
    estimate: Float[np.ndarray, "P C"], truth: Float[np.ndarray, "P C"]
) -> Float[np.ndarray, " C"]:
    """The median ratio of truth to estimate per channel, over estimates above zero; 1 if there is none."""
    ratios = [t[e > 0] / e[e > 0] for e, t in zip(estimate.T, truth.T, strict=True)]
    return np.array([np.median(ratio) if len(ratio) else 1.0 for ratio in ratios])


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
    """Mean distances from the points of each surface to the nearest point of the other.

    Distances are measured from every k-th point of a large set, fewer than 2 · `QUERIES` points, to all
    points of the other set. A dense target set keeps the bias from the spacing of samples small, and the mean
    needs no more terms.
    """
    return Chamfer(_mean_distance(estimate, truth), _mean_distance(truth, estimate))


def _mean_distance(points: Float[np.ndarray, "P 3"], surface: Float[np.ndarray, "Q 3"]) -> float:
    queries = points[:: max(1, len(points) // QUERIES)]
    return float(kd_tree(surface).query(queries)[0].mean())


def sample_surface(mesh: trimesh.Trimesh, count: int, seed: int = 0) -> Float[np.ndarray, "count 3"]:
    """Sample points uniformly over the area of a mesh. Deterministic for a given seed."""
    points, _ = trimesh.sample.sample_surface(mesh, count, seed=seed)
    return np.asarray(points, dtype=np.float64)


# ------------------------------------------------------------------------------------------------------ light


def log_ratio(
    estimate: Float[np.ndarray, "P C"], truth: Float[np.ndarray, "P C"]
) -> Float[np.ndarray, "P C"]:
    """ln(estimate + LOG_FLOOR) − ln(truth + LOG_FLOOR), for radiance, which spans orders of magnitude."""
    return np.log(estimate.astype(np.float64) + LOG_FLOOR) - np.log(truth.astype(np.float64) + LOG_FLOOR)


def log_error(ratio: Float[np.ndarray, "P C"]) -> float:
    """Mean absolute log ratio; 0.69 is a factor of two."""
    return float(np.abs(ratio).mean())


# ------------------------------------------------------------------------------------------------- confidence


def confidence_ratio(error: Float[np.ndarray, " P"], expected: Float[np.ndarray, " P"]) -> float | None:
    """Mean error of the half with the smaller expected errors, divided by that of the other half.

    1 means that expected errors are no better than chance. None if the other half has no error.
    """
    order = np.argsort(expected, kind="stable")
    confident, uncertain = np.split(error[order], [len(order) // 2])
    return float(confident.mean() / uncertain.mean()) if len(confident) and uncertain.mean() > 0 else None
