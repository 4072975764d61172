"""The protocol of NeILF++ on its synthetic scenes: apple/ml-neilfpp, `code/evaluation/evaluate.py`.

Details of the protocol:

- The mask comes from the estimate, not from the truth: pixels with an opacity above 95 %.
- Both images are multiplied by the mask, and the squared error is averaged over the whole frame. A small
  object therefore scores higher.
- Base colour is clipped to [0, 1] and raised to the power ln(median truth) / ln(median estimate), one power
  for all views and channels, with medians over the masked pixels of all views. Roughness and metallic are
  compared without alignment.
- Linear images are mapped by the ACES curve without clipping; display values are compared directly.
- PSNR is computed per view and averaged over the views.

The published figures use nine views per scene; here all test views of the capture are used.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float

from neilfpp_method.data.truth import Truth
from neilfpp_method.errors import UserError
from neilfpp_method.evaluate.metrics import decibels
from neilfpp_method.evaluate.published.protocol import Protocol, missing, no_surface
from neilfpp_method.evaluate.views import RenderedView, known_test_views
from neilfpp_method.shading.color import tone_map
from neilfpp_method.train.run import Run, check_material

__all__ = ["NEILF_SYNTHETIC", "aces", "frame_psnr", "median_gamma"]

NAME = "neilf-synthetic"
MAX_TRANSMITTANCE = 0.05
"""Transmittance above which a pixel is outside of the mask (`code/model/geo_volsdf.py`)."""


def aces(color: Float[np.ndarray, "H W 3"]) -> Float[np.ndarray, "H W 3"]:
    """The ACES curve of `hdr2ldr` without clipping: x (2.51 x + 0.03) / (x (2.43 x + 0.59) + 0.14)."""
    return (color * (2.51 * color + 0.03)) / (color * (2.43 * color + 0.59) + 0.14)


def frame_psnr(
    estimate: Float[np.ndarray, "H W C"], truth: Float[np.ndarray, "H W C"], mask: Bool[np.ndarray, "H W"]
) -> float:
    """PSNR over the whole frame of two images that are multiplied by a mask, dB (`calculate_psnr`)."""
    difference = (estimate.astype(np.float64) - truth.astype(np.float64)) * mask[..., None]
    return decibels(np.square(difference).mean())


def median_gamma(estimate: Float[np.ndarray, "P 3"], truth: Float[np.ndarray, "P 3"]) -> float:
    """The exponent ln(median truth) / ln(median estimate), with medians over all pixels and channels.

    Raises:
        UserError: a median is not between 0 and 1, so that the exponent is undefined.
    """
    medians = float(np.median(truth)), float(np.median(estimate))
    if not all(0 < median < 1 for median in medians):
        raise UserError(
            f"the protocol {NAME} needs a median base colour between 0 and 1; that of the truth is "
            f"{medians[0]:.3g}, that of the estimate {medians[1]:.3g}",
            "measure with --protocol neilfpp",
        )
    return float(np.log(medians[0]) / np.log(medians[1]))


def _check(run: Run) -> None:
    check_material(run)
    truth = Truth(run.capture)
    for view in run.capture.test_views:
        if truth.material(view) is None:
            places = [
                f"ground_truths/materials/{name}/{view.name}.png" for name in ("kd", "roughness", "metallic")
            ]
            what = "true base colour, roughness and metallic"
            raise missing(NAME, run.capture, view, what, " and ".join(places))


def _measure(run: Run, rendered: Sequence[RenderedView]) -> dict[str, float]:
    known = known_test_views(run, rendered).views
    masks = [view.maps["opacity"][..., 0] > 1 - MAX_TRANSMITTANCE for view in rendered]
    if not any(mask.any() for mask in masks):
        raise no_surface(run)
    pairs = list(zip(rendered, known, masks, strict=True))
    estimate = np.concatenate([view.maps["base_color"][mask] for view, _, mask in pairs])
    true = np.concatenate([known.material["base_color"][mask] for _, known, mask in pairs])
    gamma = median_gamma(estimate, true)
    names = ("render", "base_color", "roughness", "metallic")
    scores: dict[str, list[float]] = {f"{name}_psnr": [] for name in names}
    for view, truth, mask in pairs:
        image = view.maps["rgb"]
        if run.capture.hdr:
            score = frame_psnr(aces(image), aces(truth.image), mask)
        else:
            score = frame_psnr(tone_map(torch.from_numpy(image)).numpy(), truth.image, mask)
        scores["render_psnr"].append(score)
        base_color = view.maps["base_color"].clip(0, 1) ** gamma
        scores["base_color_psnr"].append(frame_psnr(base_color, truth.material["base_color"], mask))
        for name in ("roughness", "metallic"):
            scores[f"{name}_psnr"].append(frame_psnr(view.maps[name], truth.material[name], mask))
    return {name: float(np.mean(values)) for name, values in scores.items()} | {"base_color_gamma": gamma}


NEILF_SYNTHETIC = Protocol(
    name=NAME,
    source="apple/ml-neilfpp code/evaluation/evaluate.py",
    left_out="nothing; SSIM and LPIPS are disabled in the official code",
    check=_check,
    measure=_measure,
)
