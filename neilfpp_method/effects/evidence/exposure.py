"""Evidence for unequal exposure or white balance of the photographs.

The points of the capture's point cloud are looked up in every photograph that faces them. In the model each
point has one colour, and each photograph one gain per channel. Absolute rather than squared errors are
minimised, so that a view in which the point is occluded or has a highlight has little influence.

Reflections can look like exposure: a table that mirrors a window in some photographs is brighter there at
all of its points. But a gain belongs to the photograph, whereas such a reflection depends on the orientation
of the surface. So the gains are fitted to points of one orientation and evaluated at points of another, in
both directions, and the smaller of the two reductions of the error counts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from neilfpp_method.data.cameras.camera import Camera
from neilfpp_method.data.cameras.projection import project
from neilfpp_method.data.pixels.dataset import PixelDataset
from neilfpp_method.effects.measurement import Measurement, mean_of
from neilfpp_method.shading.color import CLIPPED, srgb_to_linear
from neilfpp_method.structures import OrientedPoints

__all__ = ["THRESHOLD", "Exposures", "judge_gains", "measure_exposures"]

THRESHOLD = 0.01
"""Reduction of the relative error, at points that were not fitted, above which gains are used."""
POINTS = 2000
"""Number of cloud points, drawn at random. They take one or two seconds and give gains within 1 %."""
MIN_VIEWS = 3
"""Minimum number of views per point. With fewer it cannot be decided in which view the point is occluded."""
MIN_COSINE = 0.2
"""Minimum cosine between normal and viewing direction. At flatter angles a pixel covers too much of the
surroundings of the point.
"""
DARK_SHARE = 1e-3
"""Linear values below this share of the mean are treated as noise and left out."""
ROUNDS = 50
"""Rounds of iteratively reweighted least squares, which alternates between point colours and gains."""
QUADRATIC_BELOW = 0.01
"""Offset of the errors in the weights of that iteration; smaller errors are about quadratic in the loss."""
SPLITS = 10
"""Maximum number of k-means iterations that split the points by orientation; three or four suffice."""


@dataclass(frozen=True)
class Exposures:
    """Measured relative exposures of the training photographs.

    Attributes:
        log_gain: natural logarithm of the gain of each training view and channel; the mean over the views is
            0.
        measured: reduction of the error by gains at points of another orientation than the fitted ones.
    """

    log_gain: Float[Tensor, "V 3"]
    measured: Measurement


@torch.no_grad()
def measure_exposures(pixels: PixelDataset, cloud: OrientedPoints) -> Exposures:
    """Measure the gains of the training photographs and how much they improve the agreement of the views.

    Args:
        pixels: the training pixels.
        cloud: oriented surface points in the scene frame; a few outliers do no harm.
    """
    chosen = torch.from_numpy(np.random.default_rng(0).permutation(len(cloud))[:POINTS])
    points = cloud[chosen]
    log_values = _log_values(pixels, points)
    enough_views = (~log_values.isnan()).any(-1).sum(1) >= MIN_VIEWS
    log_values, normal = log_values[enough_views], points.normal[enough_views]
    return Exposures(_gains(log_values), judge_gains(log_values, normal))


def judge_gains(log_values: Float[Tensor, "P V 3"], normal: Float[Tensor, "P 3"]) -> Measurement:
    """The reduction of the error by gains, at points of another orientation than the fitted ones.

    Args:
        log_values: logarithm of the linear value of each point in each view; NaN where a view is not usable.
        normal: unit normals of the points.

    Returns:
        The smaller of the two reductions. If one of the two has too few samples for a decision, that one.
    """
    what = "reduction of the error by gains, at points of another orientation"
    group, measured = _split_by_orientation(normal), []
    for held_back in (group, ~group):
        gain = _gains(log_values[~held_back])
        saved = _error(log_values[held_back], torch.zeros_like(gain)) - _error(log_values[held_back], gain)
        measured.append(mean_of(saved[~saved.isnan()], what, THRESHOLD))
    undecided = [measurement for measurement in measured if measurement.favours(chosen=False) is None]
    return undecided[0] if undecided else min(measured, key=lambda measurement: measurement.value)


def _split_by_orientation(normal: Float[Tensor, "P 3"]) -> Bool[Tensor, " P"]:
    """Split points into two groups by their normals, by k-means."""
    group = torch.zeros(len(normal), dtype=torch.bool)
    if not len(normal):
        return group
    common = torch.nn.functional.normalize(normal.sum(0), dim=0)
    center = torch.stack((common, normal[(normal @ common).argmin()]))
    for _ in range(SPLITS):
        group = (normal @ center.T).argmax(1) == 1
        if group.all() or not group.any():
            break
        means = torch.stack((normal[~group].mean(0), normal[group].mean(0)))
        center = torch.nn.functional.normalize(means, dim=-1)
    return group


def _log_values(pixels: PixelDataset, points: OrientedPoints) -> Float[Tensor, "P V 3"]:
    """Logarithm of the linear value of each point in each view; NaN where the view is not usable."""
    log_values = torch.full((len(points), len(pixels.views), 3), torch.nan)
    for number, view in enumerate(pixels.views):
        camera = pixels.capture.scene_camera(view)
        projected = project(camera, points.position)
        column, row = projected.pixel.floor().long().unbind(-1)
        # The eight neighbouring pixels must lie in the image as well.
        within = (column > 0) & (row > 0) & (column < camera.width - 1) & (row < camera.height - 1)
        at = torch.nonzero(within & (projected.depth > 0) & (_cosine(camera, points) > MIN_COSINE))[:, 0]
        if len(at):
            log_values[at, number] = _log_mean_around(pixels, number, column[at], row[at])
    return log_values


def _cosine(camera: Camera, points: OrientedPoints) -> Float[Tensor, " P"]:
    """Cosine between the normal of each point and the direction to the camera."""
    to_camera = torch.as_tensor(camera.c2w[:, 3], dtype=points.position.dtype) - points.position
    return (torch.nn.functional.normalize(to_camera, dim=-1) * points.normal).sum(-1)


def _log_mean_around(pixels: PixelDataset, number: int, column: Tensor, row: Tensor) -> Float[Tensor, "N 3"]:
    """Logarithm of the mean over the 3 × 3 pixels around each given pixel.

    It is NaN if one of the nine is clipped, invalid or off the object, or if their mean is too dark.
    """
    step = torch.arange(-1, 2)
    rows = (row[:, None, None] + step[:, None]) * pixels.views[number].camera.width
    flat = (rows + column[:, None, None] + step).reshape(-1)
    batch = pixels.at(number, flat)
    color = batch.color.cpu() if pixels.capture.hdr else srgb_to_linear(batch.color.cpu())
    usable = (batch.mask.cpu() > 0.5) & pixels.valid(number).cpu()[flat]
    if not pixels.capture.hdr:
        usable &= batch.color.cpu().amax(-1) < CLIPPED
    mean = color.view(-1, 9, 3).mean(1)
    good = usable.view(-1, 9).all(1, keepdim=True) & (mean > DARK_SHARE * color.mean())
    return torch.where(good, mean.clamp_min(1e-20).log(), torch.nan)


def _gains(log_values: Float[Tensor, "P V 3"]) -> Float[Tensor, "V 3"]:
    """Log gains that minimise the sum of absolute errors, jointly with the colours of the points.

    The gain of a view that shows none of the points is about 0.
    """
    usable = ~log_values.isnan()
    values, weight = log_values.nan_to_num(0.0), usable.float()
    gain, color = torch.zeros(log_values.shape[1:]), torch.zeros(len(log_values), 1, 3)
    for _ in range(ROUNDS):
        color = (weight * (values - gain)).sum(1, keepdim=True) / weight.sum(1, keepdim=True).clamp_min(1e-6)
        gain = (weight * (values - color)).sum(0) / weight.sum(0).clamp_min(1e-6)
        gain = gain - gain.mean(0)
        weight = usable / ((values - color - gain).abs() + QUADRATIC_BELOW)
    return gain


def _error(log_values: Float[Tensor, "P V 3"], gain: Float[Tensor, "V 3"]) -> Float[Tensor, " P"]:
    """Mean relative deviation of the views of each point from their median, after division by the gains."""
    common = log_values - gain
    return (common - common.nanmedian(1, keepdim=True).values).abs().nanmean((1, 2))
