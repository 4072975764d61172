"""Evidence for errors of the camera poses: poses are fitted to some pixels and judged at others.

If geometry and radiance have been learned from inaccurate poses, they agree on a mean of the photographs,
from which each photograph is displaced. A correction of its pose then reduces the error also at pixels to
which it was not fitted. If the poses are accurate, a correction only follows errors of G and R.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from neilfpp_method.data.pixels.dataset import PixelDataset
from neilfpp_method.effects.measurement import Measurement, mean_of
from neilfpp_method.effects.pose_fit import fit_poses, pixel_errors
from neilfpp_method.fields.poses import PoseMotion
from neilfpp_method.lighting.decision import MIN_SAMPLES
from neilfpp_method.model import NeilfModel

__all__ = ["THRESHOLD", "next_motion", "pose_evidence"]

THRESHOLD = 0.03
"""Reduction of the error at held-back pixels above which poses are corrected. With random errors of 0.3°
the reduction was 3.5 to 7 %. With accurate poses it was at most 0.5 %, except in the short demo, whose G and
R are blurred (1.5 ± 0.4 %).
"""
JUDGED_VIEWS = 10
"""Maximum number of views in which poses are judged."""
JUDGED_PIXELS = 192
"""Mean number of pixels per judged view."""
FITTED_PIXELS = 192
"""Mean number of pixels per view in a fit of all poses."""


@torch.no_grad()
def pose_evidence(model: NeilfModel, given: PixelDataset) -> Measurement:
    """Reduction of the error of R at held-back pixels by a correction of the poses.

    Args:
        model: the half-trained model; its training mode is left unchanged.
        given: the training pixels with poses as given, drawn with torch's generator.
    """
    views, pixel = len(given.views), pixel_angles(given)
    judged = torch.arange(min(views, JUDGED_VIEWS)) * views // min(views, JUDGED_VIEWS)
    numbers = given.draw(JUDGED_PIXELS * views)
    numbers = numbers[torch.isin(given.view_of(numbers), judged)]
    batch, still = given.numbered(numbers), PoseMotion.none(views).to(given.device)
    # Every turn holds back other pixels of the same views, as many as give `MIN_SAMPLES` in all.
    turns = max(2, math.ceil(MIN_SAMPLES / len(judged)))
    turn, saved = torch.arange(len(batch), device=given.device) % turns, []
    with model.evaluating():
        before = pixel_errors(model, batch, still, pixel)
        for held_back in range(turns):
            is_held_back = turn == held_back
            moved = fit_poses(model, batch[~is_held_back], still, pixel)
            part = batch[is_held_back]
            after = _by_view(pixel_errors(model, part, moved, pixel), part.view, views)
            saved.append(1 - after / _by_view(before[is_held_back], part.view, views))
    values = torch.stack(saved)[:, judged].flatten()
    what = "reduction of the error of R by corrected poses, at held-back pixels"
    return mean_of(values[values.isfinite()], what, THRESHOLD)


@torch.no_grad()
def next_motion(
    model: NeilfModel, given: PixelDataset, start: PoseMotion, centers: Float[Tensor, "V 3"]
) -> PoseMotion:
    """Improve the corrections of all training views by one fit; see `pose_evidence`.

    Args:
        start: the corrections so far.
        centers: the given camera centres, scene frame.
    """
    batch = given.numbered(given.draw(FITTED_PIXELS * len(given.views)))
    with model.evaluating():
        return fit_poses(model, batch, start, pixel_angles(given)).without_common_motion(centers)


def pixel_angles(pixels: PixelDataset) -> Float[Tensor, " V"]:
    """Angle that a pixel of each view covers, radians."""
    # Focal lengths may be NumPy's numbers, of which torch would make a tensor in double precision.
    angles = [1 / float(max(view.camera.fx, view.camera.fy)) for view in pixels.views]
    return torch.tensor(angles, device=pixels.device)


def _by_view(values: Float[Tensor, " N"], view: Int[Tensor, " N"], views: int) -> Float[Tensor, " V"]:
    """Sum of the values of each view."""
    return torch.zeros(views, device=values.device).index_add_(0, view, values)
