"""The protocol of NeILF++ on its synthetic scenes: apple/ml-neilfpp, `code/evaluation/evaluate.py`.

What is particular about it:

- The mask is that of the estimate, not of the truth: pixels of which less than 5 % shows what lies behind the
  surface.
- Both images are multiplied by the mask, and the squared error is averaged over the whole frame. A small
  object scores higher.
- Base colour is clipped to [0, 1] and raised to one power for all views and channels, ln(median truth) /
  ln(median estimate), the medians over the masked pixels of all views. Roughness and metallic are compared as
  they are.
- Linear images go through the ACES curve, unclipped; display values are compared as they are.
- PSNR is taken per view and averaged over the views.

The published figures are of nine views a scene; here all test views of the capture count.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float

from neilfpp_method.data.truth import Truth
from neilfpp_method.errors import UserError
from neilfpp_method.evaluate.published.protocol import Protocol, decibels, missing
from neilfpp_method.evaluate.views import RenderedView, known_test_views
from neilfpp_method.shading.color import tone_map
from neilfpp_method.train.run import Run

__all__ = ["NEILF_SYNTHETIC", "aces", "frame_psnr", "median_gamma"]

NAME = "neilf-synthetic"
BEHIND = 0.05
"""Share of a pixel that may show what lies behind the surface (`code/model/geo_volsdf.py`)."""


def aces(color: Float[np.ndarray, "H W 3"]) -> Float[np.ndarray, "H W 3"]:
    """The ACES curve of `hdr2ldr`: x (2.51 x + 0.03) / (x (2.43 x + 0.59) + 0.14), unclipped."""
    return (color * (2.51 * color + 0.03)) / (color * (2.43 * color + 0.59) + 0.14)


def frame_psnr(
    estimate: Float[np.ndarray, "H W C"], truth: Float[np.ndarray, "H W C"], mask: Bool[np.ndarray, "H W"]
) -> float:
    """PSNR over the whole frame of two images that are 0 outside of the mask, dB (`calculate_psnr`)."""
    difference = (estimate.astype(np.float64) - truth.astype(np.float64)) * mask[..., None]
    return decibels(np.square(difference).mean())


def median_gamma(estimate: Float[np.ndarray, "P 3"], truth: Float[np.ndarray, "P 3"]) -> float:
    """ln(median truth) / ln(median estimate), the medians over all pixels and channels.

    Raises:
        UserError: a median is 0, 1 or beyond, where there is no such power.
    """
    medians = float(np.median(truth)), float(np.median(estimate))
    if not all(0 < median < 1 for median in medians):
        raise UserError(
            f"the protocol {NAME} has no gamma: the median base colour is {medians[0]:.3g}, of the estimate "
            f"{medians[1]:.3g}",
            "it needs both between 0 and 1; measure with --protocol neilfpp",
        )
    return float(np.log(medians[0]) / np.log(medians[1]))


def _check(run: Run) -> None:
    if not run.has_material:
        raise UserError(f"{run.path}: there is no material at step {run.step}", "train the next stage")
    truth = Truth(run.capture)
    for view in run.capture.test_views:
        if truth.material(view) is None:
            places = [
                f"ground_truths/materials/{name}/{view.name}.png" for name in ("kd", "roughness", "metallic")
            ]
            what = "true base colour, roughness and metallic"
            raise missing(NAME, run.capture, view, what, f"{places[0]}, {places[1]} and {places[2]}")


def _measure(run: Run, rendered: Sequence[RenderedView]) -> dict[str, float]:
    known = known_test_views(run, rendered).views
    masks = [view.maps["opacity"][..., 0] > 1 - BEHIND for view in rendered]
    if not any(mask.any() for mask in masks):
        raise UserError(
            f"{run.path}: no test view shows a surface", "train longer, or look at the run's report"
        )
    pairs = list(zip(rendered, known, masks, strict=True))
    estimate = np.concatenate([view.maps["base_color"][mask] for view, _, mask in pairs])
    gamma = median_gamma(
        estimate, np.concatenate([known.material["base_color"][mask] for _, known, mask in pairs])
    )
    names = ("render", "base_color", "roughness", "metallic")
    scores: dict[str, list[float]] = {f"{name}_psnr": [] for name in names}
    for view, truth, mask in pairs:
        shown = view.maps["rgb"]
        if run.capture.hdr:
            score = frame_psnr(aces(shown), aces(truth.image), mask)
        else:
            score = frame_psnr(tone_map(torch.from_numpy(shown)).numpy(), truth.image, mask)
        scores["render_psnr"].append(score)
        base_color = view.maps["base_color"].clip(0, 1) ** gamma
        scores["base_color_psnr"].append(frame_psnr(base_color, truth.material["base_color"], mask))
        for name in ("roughness", "metallic"):
            scores[f"{name}_psnr"].append(frame_psnr(view.maps[name], truth.material[name], mask))
    return {name: float(np.mean(values)) for name, values in scores.items()} | {"base_color_gamma": gamma}


NEILF_SYNTHETIC = Protocol(
    name=NAME,
    source="apple/ml-neilfpp code/evaluation/evaluate.py",
    left_out="nothing: SSIM and LPIPS are switched off there, too",
    check=_check,
    measure=_measure,
)
