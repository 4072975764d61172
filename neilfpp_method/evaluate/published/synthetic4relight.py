"""The protocol of Synthetic4Relight, the dataset of InvRender.

zju3dv/InvRender has no evaluation script. The figures are computed as in TCZ-Tao/IRGS,
`eval_material_syn4.py` and `compute_albedo_scale_syn4.py`.

The layout is that of the dataset: `<view>_albedo.png`, and `<view>_rough.png` or `<view>_roughness.png`,
beside `<view>_rgba.png`.

Details of the protocol:

- The true albedo, in sRGB, is multiplied by its alpha and then converted to linear values. Everything is
  compared in linear values.
- Albedo is multiplied by a factor per channel: the median of truth / estimate over the pixels of all test
  views at which the truth has an alpha above 0; of an even number of values, the lower of the middle two.
  Nothing is clipped.
- Estimate and truth are multiplied by the alpha of the image, and errors are averaged over the whole frame.
- PSNR is computed per channel and averaged over channels and views, so a channel with a small error has as
  much weight as one with a large error.
- SSIM has a window of 11 pixels, and zeros beyond the border.
- The error of roughness is the mean squared error, averaged over views. The official code repeats the channel
  three times, which does not change the mean.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from neilfpp_method.data.capture import Capture
from neilfpp_method.data.views import View
from neilfpp_method.errors import UserError
from neilfpp_method.evaluate.metrics import decibels
from neilfpp_method.evaluate.published.protocol import Protocol, missing
from neilfpp_method.evaluate.published.similarity import ssim_map
from neilfpp_method.evaluate.published.tensoir import albedo_factor
from neilfpp_method.evaluate.published.truth_files import alpha_of, check_full_size, existing, read_beside
from neilfpp_method.evaluate.views import RenderedView
from neilfpp_method.shading.color import srgb_to_linear
from neilfpp_method.train.run import Run, check_material

__all__ = ["SYNTHETIC4RELIGHT"]

NAME = "synthetic4relight"
ROUGHNESS_NAMES = ("rough", "roughness")
"""Ends of the name of the file with the true roughness, the first that exists."""


@dataclass(frozen=True)
class _True:
    """The truth of a view.

    Attributes:
        albedo: linear albedo times its alpha.
        roughness: roughness times its alpha.
        albedo_alpha: alpha of the file of the albedo.
        alpha: alpha of the image.
    """

    albedo: Float[np.ndarray, "H W 3"]
    roughness: Float[np.ndarray, "H W 1"]
    albedo_alpha: Float[np.ndarray, "H W 1"]
    alpha: Float[np.ndarray, "H W 1"]


def _true_path(view: View, name: str) -> Path:
    """The file of a true map of a view, beside its image."""
    return view.image.with_name(f"{view.image.stem.removesuffix('_rgba')}_{name}.png")


def _roughness_path(capture: Capture, view: View) -> Path | None:
    """The file of the true roughness, which has one of two names; None if there is none."""
    return existing(capture.root, *(_true_path(view, name) for name in ROUGHNESS_NAMES))


def _true(capture: Capture, view: View) -> _True:
    image, albedo = read_beside(view.image, view), read_beside(_true_path(view, "albedo"), view)
    rough = read_beside(_roughness_path(capture, view) or _true_path(view, ROUGHNESS_NAMES[0]), view)
    albedo_alpha = alpha_of(albedo)
    linear = srgb_to_linear(torch.from_numpy(albedo.pixels * albedo_alpha)).numpy()
    return _True(linear, rough.pixels[..., :1] * alpha_of(rough), albedo_alpha, alpha_of(image))


def _check(run: Run) -> None:
    check_material(run)
    root = run.capture.root
    for view in run.capture.test_views:
        check_full_size(NAME, view)
        albedo, roughness = _true_path(view, "albedo"), _true_path(view, ROUGHNESS_NAMES[0])
        if existing(root, albedo) is None:
            raise missing(NAME, run.capture, view, "true albedo", str(albedo.relative_to(root)))
        if _roughness_path(run.capture, view) is None:
            raise missing(NAME, run.capture, view, "true roughness", str(roughness.relative_to(root)))


def _measure(run: Run, rendered: Sequence[RenderedView]) -> dict[str, float]:
    true = [_true(run.capture, view) for view in run.capture.test_views]
    covered = [t.albedo_alpha[..., 0] > 0 for t in true]
    if not any(mask.any() for mask in covered):
        raise UserError(
            f"the protocol {NAME}: no pixel of the true albedo has an alpha above 0", "render it again"
        )
    albedo = [view.maps["base_color"] for view in rendered]
    factor = albedo_factor(
        np.concatenate([a[mask] for a, mask in zip(albedo, covered, strict=True)]),
        np.concatenate([t.albedo[mask] for t, mask in zip(true, covered, strict=True)]),
    )
    scores: dict[str, list[float]] = {"albedo_psnr": [], "albedo_ssim": [], "roughness_mse": []}
    for view, t in zip(rendered, true, strict=True):
        estimate, truth = view.maps["base_color"] * factor * t.alpha, t.albedo * t.alpha
        squared = np.square(estimate.astype(np.float64) - truth).mean((0, 1))
        scores["albedo_psnr"].append(float(np.mean([decibels(error) for error in squared])))
        scores["albedo_ssim"].append(float(ssim_map(estimate, truth).mean()))
        rough = (view.maps["roughness"] - t.roughness) * t.alpha
        scores["roughness_mse"].append(float(np.square(rough, dtype=np.float64).mean()))
    return {name: float(np.mean(values)) for name, values in scores.items()}


SYNTHETIC4RELIGHT = Protocol(
    name=NAME,
    source="TCZ-Tao/IRGS eval_material_syn4.py",
    left_out=(
        "LPIPS, whose weights must be downloaded; new views; relit images, which neilfpp relight --truth "
        "measures"
    ),
    check=_check,
    measure=_measure,
)
