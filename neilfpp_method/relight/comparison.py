"""A relit run against true images of the same views under the same light.

relight_psnr, relight_ssim    both tone-mapped as a display shows them, masked, mean over views
relight_psnr_linear           the same on linear radiance, peak 1
*_scaled                      with one factor per channel for all views, by least squares on linear
                              radiance: base colour and light share a factor that images do not tell
*_frame                       the same over the whole frame, the background counted as free of error
baseline_*                    the capture's own image of the view, taken for the relit one
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float

from neilfpp_method.data.capture import Capture
from neilfpp_method.data.images import IMAGE_SUFFIXES, image_header, read_image
from neilfpp_method.data.truth import Truth
from neilfpp_method.data.views import View
from neilfpp_method.errors import UserError
from neilfpp_method.evaluate import metrics
from neilfpp_method.shading.color import srgb_to_linear, tone_map

__all__ = ["Compared", "TrueImage", "compare", "find_truth", "read_truth"]


@dataclass(frozen=True)
class TrueImage:
    """The true image of a view, linear; its counted pixels and their origin; the capture's image."""

    name: str
    image: Float[np.ndarray, "H W 3"]
    mask: Bool[np.ndarray, "H W"] | None
    mask_source: str
    photograph: Float[np.ndarray, "H W 3"]


@dataclass(frozen=True)
class Compared:
    """Figures by name, PSNR of each view, the factors, and what decided which pixels count."""

    figures: Mapping[str, float]
    views: Mapping[str, float]
    scale: tuple[float, ...]
    mask_source: str


def find_truth(folder: Path, views: Sequence[View]) -> dict[str, Path]:
    """The file of each view, `<folder>/<view>.exr` or another image of that name; headers are looked at.

    Raises:
        UserError: a view has none, or one of another size.
    """
    found = {}
    for view in views:
        files = [path for suffix in IMAGE_SUFFIXES if (path := folder / f"{view.name}{suffix}").is_file()]
        if not files:
            raise UserError(
                f"{folder}: no true image of the view {view.name}", f"name it {view.name}.exr, or .png"
            )
        header = image_header(files[0])
        if (header.width, header.height) != (view.camera.width, view.camera.height):
            wanted = f"{view.camera.width}×{view.camera.height}"
            size = f"{header.width}×{header.height} pixels where the view has {wanted}"
            raise UserError(f"{files[0]}: {size}", "render the true image again in the size of the view")
        found[view.name] = files[0]
    return found


def read_truth(capture: Capture, view: View, path: Path) -> TrueImage:
    """A true image and its counted pixels: by alpha, else by true depth, else by the view's mask.

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
) -> Compared:
    """Figures of relit views, linear radiance over black, each against the true image of the same view.

    Raises:
        UserError: no pixel counts.
    """
    pairs = zip(opacity, truth, strict=True)
    masks = [seen > 0.5 if true.mask is None else true.mask for seen, true in pairs]
    if not any(mask.any() for mask in masks):
        raise UserError(
            "no pixel of the true images shows a surface", "give images of the views, with their masks"
        )
    images, names = [true.image for true in truth], [true.name for true in truth]
    figures, views, scale = _figures("relight", relit, images, masks, names)
    baseline, _, _ = _figures("baseline", [true.photograph for true in truth], images, masks, names)
    sources = sorted({true.mask_source for true in truth})
    return Compared(figures | baseline, views, scale, ", ".join(sources))


def _figures(
    title: str,
    estimates: Sequence[np.ndarray],
    images: Sequence[np.ndarray],
    masks: Sequence[np.ndarray],
    names: Sequence[str],
) -> tuple[dict[str, float], dict[str, float], tuple[float, ...]]:
    """Means over the views that have pixels, the scaled PSNR of each, and the factors."""
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
        shown = _shown(image)
        for suffix, linear in {"": estimate, "_scaled": estimate * scale}.items():
            values = {
                "psnr": metrics.psnr(_shown(linear), shown, mask),
                "psnr_linear": metrics.psnr(linear, image, mask),
                "psnr_frame": metrics.psnr_frame(_shown(linear), shown, mask),
            }
            if min(mask.shape) >= metrics.SSIM_WINDOW:
                values["ssim"] = metrics.ssim(_shown(linear), shown, mask)
            for key, value in values.items():
                scores.setdefault(f"{title}_{key}{suffix}", []).append(value)
            if suffix:
                views[name] = values["psnr"]
    return (
        {key: float(np.mean(values)) for key, values in scores.items()},
        views,
        tuple(float(s) for s in scale),
    )


def _linear(pixels: Float[np.ndarray, "H W C"], linear: bool) -> Float[np.ndarray, "H W 3"]:
    values = pixels if linear else srgb_to_linear(torch.from_numpy(pixels)).numpy()
    return np.repeat(values, 3, axis=-1) if values.shape[-1] == 1 else values


def _shown(linear: Float[np.ndarray, "H W 3"]) -> Float[np.ndarray, "H W 3"]:
    return tone_map(torch.from_numpy(np.ascontiguousarray(linear, np.float32))).numpy()
