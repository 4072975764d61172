"""Compare relit views with true images of the same views under the same light.

Figures:

    relight_psnr, relight_ssim    both tone-mapped, over masked pixels, mean over views
    relight_psnr_linear           the same on linear radiance, peak 1
    *_scaled                      after one least-squares factor per channel for all views, on linear
                                  radiance: images determine base colour and light only up to this factor
    *_frame                       the same over the whole frame, the background counted as free of error
    baseline_*                    the same figures for the photograph of the view, not the relit image
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float

from neilfpp_method.data.capture import Capture
from neilfpp_method.data.files.images import IMAGE_SUFFIXES, image_header, read_image
from neilfpp_method.data.truth import Truth
from neilfpp_method.data.views import View
from neilfpp_method.errors import UserError
from neilfpp_method.evaluate import metrics
from neilfpp_method.shading.color import srgb_to_linear, tone_map

__all__ = ["RelitComparison", "TrueImage", "compare", "find_truth", "read_truth"]


@dataclass(frozen=True)
class TrueImage:
    """The true image of a view.

    Attributes:
        name: name of the view.
        image: the true image, linear.
        mask: pixels that count; None if the opacity of the relit image decides.
        mask_source: where the mask comes from.
        photograph: the capture's image of the view, linear.
    """

    name: str
    image: Float[np.ndarray, "H W 3"]
    mask: Bool[np.ndarray, "H W"] | None
    mask_source: str
    photograph: Float[np.ndarray, "H W 3"]


@dataclass(frozen=True)
class RelitComparison:
    """The result of a comparison.

    Attributes:
        figures: figures by name.
        views: scaled PSNR of each view by name.
        scale: the factor per channel.
        mask_source: where the masks come from.
    """

    figures: Mapping[str, float]
    views: Mapping[str, float]
    scale: tuple[float, ...]
    mask_source: str


def find_truth(folder: Path, views: Sequence[View]) -> dict[str, Path]:
    """Find the true image of each view, `<folder>/<view>.exr` or another type of image, and check its size.

    Raises:
        UserError: a view has no true image, or one of a different size.
    """
    paths = {}
    for view in views:
        files = [path for suffix in IMAGE_SUFFIXES if (path := folder / f"{view.name}{suffix}").is_file()]
        if not files:
            raise UserError(
                f"{folder}: no true image of the view {view.name}", f"name it {view.name}.exr, or .png"
            )
        header = image_header(files[0])
        if (header.width, header.height) != (view.camera.width, view.camera.height):
            wanted = f"{view.camera.width}×{view.camera.height}"
            size = f"{header.width}×{header.height} pixels, but the view has {wanted}"
            raise UserError(f"{files[0]}: {size}", "render the true image again in the size of the view")
        paths[view.name] = files[0]
    return paths


def read_truth(capture: Capture, view: View, path: Path) -> TrueImage:
    """Read a true image, with a mask from its alpha, or else from true depth, or else from the view's mask.

    Raises:
        UserError: an image cannot be read, or has values that are not finite.
    """
    file = read_image(path)
    image = _linear(file.pixels, file.hdr)
    if not np.isfinite(image).all():
        raise UserError(f"{path}: a pixel is not finite", "render it again")
    depth = Truth(capture).depth(view)
    if file.alpha is not None:
        mask, source = file.alpha > 0.5, "alpha of the true images"
    elif depth is not None:
        mask, source = (depth > 0).view(image.shape[:2]).numpy(), "true depth"
    elif view.mask is not None:
        mask, source = read_image(view.mask).mask > 0.5, "capture masks"
    else:
        mask, source = None, "rendered opacity"
    photograph = read_image(view.image).pixels
    gain = np.float32(view.exposure) * np.asarray(view.white_balance, np.float32)
    return TrueImage(view.name, image, mask, source, _linear(photograph, capture.hdr) / gain)


def compare(
    relit: Sequence[Float[np.ndarray, "H W 3"]],
    opacity: Sequence[Float[np.ndarray, "H W"]],
    truth: Sequence[TrueImage],
) -> RelitComparison:
    """Compute the figures of relit views against the true images.

    Args:
        relit: linear radiance of each view, over black.
        opacity: opacity of each view.
        truth: the true image of each view.

    Raises:
        UserError: all masks are empty.
    """
    pairs = zip(opacity, truth, strict=True)
    masks = [alpha > 0.5 if true.mask is None else true.mask for alpha, true in pairs]
    if not any(mask.any() for mask in masks):
        raise UserError(
            "no pixel of the true images shows a surface", "give images of the views, with their masks"
        )
    images, names = [true.image for true in truth], [true.name for true in truth]
    ours = _scores("relight", relit, images, masks, names)
    baseline = _scores("baseline", [true.photograph for true in truth], images, masks, names)
    sources = sorted({true.mask_source for true in truth})
    return RelitComparison(ours.figures | baseline.figures, ours.views, ours.scale, ", ".join(sources))


@dataclass(frozen=True)
class _Scores:
    """Figures averaged over the views with a non-empty mask, scaled PSNR of each view, and the factors."""

    figures: dict[str, float]
    views: dict[str, float]
    scale: tuple[float, ...]


def _scores(
    title: str,
    estimates: Sequence[np.ndarray],
    images: Sequence[np.ndarray],
    masks: Sequence[np.ndarray],
    names: Sequence[str],
) -> _Scores:
    pooled = [
        np.concatenate([image[mask] for image, mask in zip(side, masks, strict=True)])
        for side in (estimates, images)
    ]
    scale = metrics.align_scale(*pooled)
    scores: dict[str, list[float]] = {}
    views = {}
    for name, estimate, image, mask in zip(names, estimates, images, masks, strict=True):
        if not mask.any():
            continue
        displayed_truth = _tone_mapped(image)
        for suffix, linear in {"": estimate, "_scaled": estimate * scale}.items():
            displayed = _tone_mapped(linear)
            values = {
                "psnr": metrics.psnr(displayed, displayed_truth, mask),
                "psnr_linear": metrics.psnr(linear, image, mask),
                "psnr_frame": metrics.psnr_frame(displayed, displayed_truth, mask),
            }
            if min(mask.shape) >= metrics.SSIM_WINDOW:
                values["ssim"] = metrics.ssim(displayed, displayed_truth, mask)
            for key, value in values.items():
                scores.setdefault(f"{title}_{key}{suffix}", []).append(value)
            if suffix:
                views[name] = values["psnr"]
    figures = {key: float(np.mean(values)) for key, values in scores.items()}
    return _Scores(figures, views, tuple(float(s) for s in scale))


def _linear(pixels: Float[np.ndarray, "H W C"], linear: bool) -> Float[np.ndarray, "H W 3"]:
    values = pixels if linear else srgb_to_linear(torch.from_numpy(pixels)).numpy()
    return np.repeat(values, 3, axis=-1) if values.shape[-1] == 1 else values


def _tone_mapped(linear: Float[np.ndarray, "H W 3"]) -> Float[np.ndarray, "H W 3"]:
    return tone_map(torch.from_numpy(np.ascontiguousarray(linear, np.float32))).numpy()
