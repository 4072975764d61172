"""Evidence for photographs of unequal exposure or white balance: the same places, brighter in some of them.

The points of the capture's cloud are looked up in every photograph that faces them. A place has its own
colour, and a photograph its own gain for each channel. Errors count by their size, not by their square, so
that a view in which something hides a place, or a highlight lies on it, has little say.

A table that mirrors a window in some photographs is brighter there as well, at all of its points. An exposure
goes with the photograph, a sheen with the way that a surface faces. So gains of the points that face one way
are judged at those that face another, and the worse of the two ways decides.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from neilfpp_method.data.pixels import PixelDataset
from neilfpp_method.data.views import Camera, project
from neilfpp_method.effects.measurement import Measurement, mean_of
from neilfpp_method.shading.color import CLIPPED, srgb_to_linear
from neilfpp_method.structures import OrientedPoints

__all__ = ["WORTH", "Exposures", "judge_gains", "measure_exposures"]

WORTH = 0.01
"""Relative error that gains must save at points that they were not fitted to."""
POINTS = 2000
"""So many points of the cloud, drawn at random: a second or two, and gains within a percent."""
MIN_VIEWS = 3
"""Views that must show a point: of fewer, nothing tells which of them is hidden from it."""
MIN_COSINE = 0.2
"""A view that faces a point at a flatter angle does not count: it covers too much of what lies beside it."""
DARK = 1e-3
"""Linear values below this share of the mean are noise."""
ROUNDS = 50
"""Of means over the places and over the photographs in turns, with weights by the errors before."""
QUADRATIC_BELOW = 0.01
"""Errors below this, relative, count by their square."""
SPLITS = 10
"""Steps in which points are parted by their normals (k-means); they settle in three or four."""


@dataclass(frozen=True)
class Exposures:
    """What the photographs say of their own gains.

    Attributes:
        log_gain: natural logarithms, of the training views and channels; their mean over the views is 0.
        measured: the error that gains save at points that face another way than those they were fitted to.
    """

    log_gain: Float[Tensor, "V 3"]
    measured: Measurement


@torch.no_grad()
def measure_exposures(pixels: PixelDataset, cloud: OrientedPoints) -> Exposures:
    """The gains of the training photographs, and whether they are worth having.

    Args:
        pixels: of the training views.
        cloud: of the surface, scene frame; points without a surface there do no harm while they are few.
    """
    chosen = torch.from_numpy(np.random.default_rng(0).permutation(len(cloud))[:POINTS])
    points = cloud[chosen]
    seen = _seen(pixels, points)
    known = (~seen.isnan()).any(-1).sum(1) >= MIN_VIEWS
    seen, normal = seen[known], points.normal[known]
    return Exposures(_gains(seen), judge_gains(seen, normal))


def judge_gains(seen: Float[Tensor, "P V 3"], normal: Float[Tensor, "P 3"]) -> Measurement:
    """The error that gains save at points that face another way than those that they were fitted to.

    Args:
        seen: the logarithm of what each view shows at each point; NaN where it shows nothing of use.
        normal: of the points, unit.
    """
    what = "error that gains of photographs save at points that face another way"
    group, measured = _facing(normal), []
    for back in (group, ~group):
        gain = _gains(seen[~back])
        saved = _error(seen[back], torch.zeros_like(gain)) - _error(seen[back], gain)
        measured.append(mean_of(saved[~saved.isnan()], what, WORTH))
    few = [found for found in measured if found.favours(chosen=False) is None]
    return (few or sorted(measured, key=lambda found: found.value))[0]


def _facing(normal: Float[Tensor, "P 3"]) -> Bool[Tensor, " P"]:
    """Points in two groups by the way that they face."""
    group = torch.zeros(len(normal), dtype=torch.bool)
    if not len(normal):
        return group
    common = torch.nn.functional.normalize(normal.sum(0), dim=0)
    centre = torch.stack((common, normal[(normal @ common).argmin()]))
    for _ in range(SPLITS):
        group = (normal @ centre.T).argmax(1) == 1
        if group.all() or not group.any():
            break
        means = torch.stack((normal[~group].mean(0), normal[group].mean(0)))
        centre = torch.nn.functional.normalize(means, dim=-1)
    return group


def _seen(pixels: PixelDataset, points: OrientedPoints) -> Float[Tensor, "P V 3"]:
    """The logarithm of what each view shows at each point, linear; NaN where it shows nothing of use."""
    seen = torch.full((len(points), len(pixels.views), 3), torch.nan)
    for number, view in enumerate(pixels.views):
        camera = pixels.capture.normalisation.camera(view.camera)
        shown = project(camera, points.position)
        column, row = shown.pixel.floor().long().unbind(-1)
        # The eight pixels around must be there, too.
        within = (column > 0) & (row > 0) & (column < camera.width - 1) & (row < camera.height - 1)
        at = torch.nonzero(within & (shown.depth > 0) & (_cosine(camera, points) > MIN_COSINE))[:, 0]
        if len(at):
            seen[at, number] = _around(pixels, number, column[at], row[at])
    return seen


def _cosine(camera: Camera, points: OrientedPoints) -> Float[Tensor, " P"]:
    towards = torch.as_tensor(camera.c2w[:, 3], dtype=points.position.dtype) - points.position
    return (torch.nn.functional.normalize(towards, dim=-1) * points.normal).sum(-1)


def _around(pixels: PixelDataset, number: int, column: Tensor, row: Tensor) -> Float[Tensor, "N 3"]:
    """The logarithm of the mean of nine pixels each; NaN where one of them is clipped, dark, invalid or off
    the object.
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
    good = usable.view(-1, 9).all(1, keepdim=True) & (mean > DARK * color.mean())
    return torch.where(good, mean.clamp_min(1e-20).log(), torch.nan)


def _gains(seen: Float[Tensor, "P V 3"]) -> Float[Tensor, "V 3"]:
    """Log gains, and with them the colours of the places, of the least sum of sizes of errors; 0 for a view
    that shows none of the points.
    """
    there = ~seen.isnan()
    known, weight = seen.nan_to_num(0.0), there.float()
    gain, place = torch.zeros(seen.shape[1:]), torch.zeros(len(seen), 1, 3)
    for _ in range(ROUNDS):
        place = (weight * (known - gain)).sum(1, keepdim=True) / weight.sum(1, keepdim=True).clamp_min(1e-6)
        gain = (weight * (known - place)).sum(0) / weight.sum(0).clamp_min(1e-6)
        gain = gain - gain.mean(0)
        weight = there / ((known - place - gain).abs() + QUADRATIC_BELOW)
    return gain


def _error(seen: Float[Tensor, "P V 3"], gain: Float[Tensor, "V 3"]) -> Float[Tensor, " P"]:
    """How far the views of a place are from its median, in the mean, as a share of it."""
    common = seen - gain
    return (common - common.nanmedian(1, keepdim=True).values).abs().nanmean((1, 2))
