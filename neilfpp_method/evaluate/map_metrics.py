"""Figures of the maps of test views: images, material, normals, confidence, and baselines."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from neilfpp_method.data.capture import Capture
from neilfpp_method.evaluate import metrics
from neilfpp_method.evaluate.confidence import material_deviation, measure_residuals, surface_at_pixels
from neilfpp_method.evaluate.views import KnownView, RenderedView, mean_observed_color, surface_points
from neilfpp_method.shading.color import CLIPPED, display_values, srgb_to_linear, tone_map
from neilfpp_method.structures import OrientedPoints
from neilfpp_method.train.run import Run

__all__ = [
    "baseline_metrics",
    "confidence_metrics",
    "exposed_alike",
    "image_metrics",
    "material_metrics",
    "normal_metrics",
]

CONFIDENCE_PIXELS = 8192
"""Number of evenly spread test pixels at which the error is compared with the expected error."""

Pairs = Sequence[tuple[RenderedView, KnownView]]
"""Test views as rendered and as captured."""


class Scores(defaultdict[str, list[float]]):
    """Figures of single views by name, and their means over the views that have a value."""

    def __init__(self) -> None:
        super().__init__(list)

    def means(self) -> dict[str, float]:
        """Mean of each figure over its values that are not NaN; a figure without such a value is left out."""
        kept = {name: [v for v in values if not np.isnan(v)] for name, values in self.items()}
        return {name: float(np.mean(values)) for name, values in kept.items() if values}


def image_metrics(run: Run, pairs: Pairs) -> dict[str, float]:
    """PSNR and SSIM of the volume-rendered images and, if there is a material, of the PBR images."""
    rendered = {"volume": "rgb_volume"} | ({"pbr": "rgb"} if run.has_material else {})
    scores = Scores()
    for view, known in pairs:
        image = display_values(torch.from_numpy(known.image), run.facts.response).numpy()
        for name, key in rendered.items():
            estimate = _tone_mapped(view.maps[key])
            scores[f"{name}_psnr"].append(metrics.psnr(estimate, image, known.mask))
            if min(known.mask.shape) >= metrics.SSIM_WINDOW:
                scores[f"{name}_ssim"].append(metrics.ssim(estimate, image, known.mask))
            if run.model.gains is not None:
                exposed = exposed_alike(view.maps[key], known.image, known.mask, run.facts.response)
                scores[f"{name}_psnr_exposed"].append(metrics.psnr(_tone_mapped(exposed), image, known.mask))
            if run.capture.hdr:
                scores[f"{name}_psnr_linear"].append(metrics.psnr(view.maps[key], known.image, known.mask))
    return scores.means()


def exposed_alike(
    estimate: Float[np.ndarray, "H W 3"],
    image: Float[np.ndarray, "H W 3"],
    mask: Bool[np.ndarray, "H W"],
    response: str,
) -> Float[np.ndarray, "H W 3"]:
    """Scale an estimate to the exposure of an image.

    The exposure of a new view cannot be known from training. The factor per channel is the median ratio of
    the linear values, over masked pixels that are not clipped. A least-squares factor would depend on a few
    highlights that are a hundred times brighter than the image.

    Args:
        estimate: rendered linear radiance.
        image: the image as captured.
        mask: the pixels that count.
        response: "linear" or "srgb", the encoding of `image`.

    Returns:
        The scaled linear radiance.
    """
    pixels = image[mask].astype(np.float64)
    unclipped = np.ones(len(pixels), dtype=bool)
    if response == "srgb":
        unclipped = pixels.max(-1) < CLIPPED
        pixels = srgb_to_linear(torch.from_numpy(pixels)).numpy()
    gain = metrics.median_scale(estimate[mask][unclipped], pixels[unclipped])
    return (estimate * gain).astype(np.float32)


def material_metrics(run: Run, pairs: Pairs) -> dict[str, float]:
    """PSNR of the material maps; that of base colour without alignment, with one gamma, and scaled.

    Gamma and scale are fitted to all test views together. A Lambertian run has no roughness and metallic.
    """
    pairs = [(view, known) for view, known in pairs if known.material is not None]
    if not pairs or not run.has_material:
        return {}
    estimate = np.concatenate([view.maps["base_color"][known.mask] for view, known in pairs])
    true = _pooled(pairs, "base_color")
    gamma, scale = metrics.align_gamma(estimate, true), metrics.align_scale(estimate, true)
    scores = Scores()
    for view, known in pairs:
        base_color = view.maps["base_color"]
        estimates = {
            "base_color_psnr": ("base_color", base_color),
            "base_color_psnr_gamma": ("base_color", base_color**gamma),
            "base_color_psnr_scaled": ("base_color", base_color * scale),
        }
        if run.config.shading.specular:
            estimates |= {f"{name}_psnr": (name, view.maps[name]) for name in ("roughness", "metallic")}
        for key, (name, values) in estimates.items():
            scores[key].append(metrics.psnr(values, known.material[name], known.mask))
            scores[f"{key}_frame"].append(metrics.psnr_frame(values, known.material[name], known.mask))
    return scores.means()


def confidence_metrics(run: Run, pairs: Pairs) -> dict[str, float]:
    """Whether expected errors of the material predict where its errors are (`metrics.confidence_ratio`)."""
    pairs = [(view, known) for view, known in pairs if known.material is not None]
    if not pairs or not run.has_material or not run.capture.train_views:
        return {}
    rows = [np.flatnonzero(known.mask & view.surface_mask) for view, known in pairs]
    step = max(1, sum(map(len, rows)) // CONFIDENCE_PIXELS)
    rows = [r[::step] for r in rows]
    points = OrientedPoints.joined(
        [surface_at_pixels(run, view, r) for (view, _), r in zip(pairs, rows, strict=True)]
    )
    deviation = material_deviation(run.model, measure_residuals(run), points.position, points.normal)

    figures = {}
    for name in ("base_color", "roughness", "metallic") if run.config.shading.specular else ("base_color",):
        estimate = _at_rows([view.maps[name] for view, _ in pairs], rows)
        true = _at_rows([known.material[name] for _, known in pairs], rows)
        scale = metrics.align_scale(estimate, true) if name == "base_color" else 1.0
        error = np.abs(estimate * scale - true).mean(-1)
        ratio = metrics.confidence_ratio(error, getattr(deviation, name)[:, 0].cpu().numpy())
        if ratio is not None:
            figures[f"confidence_{name}_ratio"] = ratio
    return figures


def normal_metrics(pairs: Pairs) -> dict[str, float]:
    """Mean angle between estimated and true normals, degrees."""
    scores = Scores()
    for view, known in pairs:
        if known.normal is not None:
            angle = metrics.angular_error(view.maps["normal"], known.normal, known.mask)
            scores["normal_mae_deg"].append(angle)
    return scores.means()


def _at_rows(
    maps: Sequence[Float[np.ndarray, "_ _ C"]], rows: Sequence[Int[np.ndarray, " _"]]
) -> Float[np.ndarray, "Q C"]:
    """The values of maps at row-major pixel indices of each, concatenated."""
    return np.concatenate([m.reshape(-1, m.shape[-1])[r] for m, r in zip(maps, rows, strict=True)])


def _tone_mapped(color: Float[np.ndarray, "H W 3"]) -> Float[np.ndarray, "H W 3"]:
    return tone_map(torch.from_numpy(color)).numpy()


def _pooled(pairs: Pairs, name: str) -> Float[np.ndarray, "P C"]:
    """A true map at the masked pixels of all test views."""
    return np.concatenate([known.material[name][known.mask] for _, known in pairs])


def baseline_metrics(capture: Capture, pairs: Pairs) -> dict[str, float]:
    """PSNR of the naive baseline, which any method should exceed.

    Base colour is the mean colour of a surface point over the training views, times the least-squares factor
    per channel; roughness and metallic are constant, with the true mean. The baseline is optimistic, because
    its factor, its constants and its surface points come from the truth.
    """
    pairs = [(view, known) for view, known in pairs if known.material is not None]
    if not pairs:
        return {}
    scores = Scores()
    for name in ("roughness", "metallic"):
        constant = _pooled(pairs, name).mean()
        for _, known in pairs:
            true = known.material[name]
            score = metrics.psnr(np.full_like(true, constant), true, known.mask)
            scores[f"baseline_{name}_psnr"].append(score)
    if all(known.depth is not None for _, known in pairs):
        points = torch.cat([surface_points(capture, known) for _, known in pairs])
        observed = mean_observed_color(capture, points)
        if observed is not None:
            aligned = observed * metrics.align_scale(observed, _pooled(pairs, "base_color"))
            ends = np.cumsum([known.mask.sum() for _, known in pairs])[:-1]
            for part, (_, known) in zip(np.split(aligned, ends), pairs, strict=True):
                guess = np.zeros(known.image.shape)
                guess[known.mask] = part
                score = metrics.psnr(guess, known.material["base_color"], known.mask)
                scores["baseline_base_color_psnr_scaled"].append(score)
    return scores.means()
