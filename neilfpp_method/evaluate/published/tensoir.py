"""The protocol of TensoIR on TensoIR-Synthetic: Haian-Jin/TensoIR, `renderer.py` (`evaluation_iter_TensoIR`,
`compute_rescale_ratio`), `dataLoader/tensoIR_rotation_setting.py` and `utils.py` (`rgb_ssim`).

The layout is that of the dataset: a folder for each view with `rgba_<light>.png`, `albedo.png` and
`normal.png`.

What is particular about it:

- Images and albedo are blended over white by their alpha, the estimate's by its opacity, and PSNR and SSIM
  are of the whole frame. White background is free of error, and a small object scores higher.
- Albedo takes a factor per channel: the median, over the pixels with any alpha of 20 views, of truth over
  estimate. Views are k · ⌊n/20⌋, so fewer than 20 test views give the first alone. The median of an even
  number of values is the lower of the middle two. `_single` uses the factor of red for all channels.
- The scaled albedo is clipped to [0, 1]; where the truth has no alpha it is white.
- PSNR of albedo is of one squared error over all views at once, both raised to 1/2.2. Its SSIM is per view,
  without that power.
- The background counts in the error of normals: there the truth is (0, 0, 1), and so is the estimate as far
  as it is transparent. The mean is over all pixels of all views.
- SSIM leaves out the 5 pixels at the border, where its window of 11 reaches beyond the image.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float

from neilfpp_method.data.capture import Capture
from neilfpp_method.data.views import View
from neilfpp_method.errors import UserError
from neilfpp_method.evaluate.published.protocol import Protocol, decibels, missing
from neilfpp_method.evaluate.published.similarity import ssim_map
from neilfpp_method.evaluate.published.truth_files import alpha_of, check_full_size, existing, read_beside
from neilfpp_method.evaluate.views import RenderedView
from neilfpp_method.shading.color import tone_map
from neilfpp_method.train.run import Run

__all__ = ["TENSOIR", "albedo_factor", "over_white"]

NAME = "tensoir"
GAMMA = 1 / 2.2
VIEWS_OF_THE_FACTOR = 20
LEAST = 1e-6
"""The estimate is divided by no less."""
BORDER = 5
BEHIND = (0.0, 0.0, 1.0)
"""The normal of the background."""


@dataclass(frozen=True)
class _True:
    """The truth of a view; images and albedo over white, normals of unit length."""

    image: Float[np.ndarray, "H W 3"]
    albedo: Float[np.ndarray, "H W 3"]
    normal: Float[np.ndarray, "H W 3"]
    mask: Bool[np.ndarray, "H W"]


def over_white(
    color: Float[np.ndarray, "H W 3"], alpha: Float[np.ndarray, "H W 1"]
) -> Float[np.ndarray, "H W 3"]:
    """The colour where it is opaque, white where it is not."""
    return color * alpha + (1 - alpha)


def albedo_factor(
    estimate: Float[np.ndarray, "P 3"], truth: Float[np.ndarray, "P 3"]
) -> Float[np.ndarray, " 3"]:
    """The median of truth over estimate per channel; of an even number of values the lower of the middle
    two.
    """
    ratio = np.sort(truth / np.maximum(estimate, LEAST), axis=0)
    return ratio[(len(ratio) - 1) // 2]


def _unit(normal: Float[np.ndarray, "H W 3"]) -> Float[np.ndarray, "H W 3"]:
    return normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)


def _true(capture: Capture, view: View) -> _True:
    files = [existing(capture.root, view.image.with_name(name)) for name in ("albedo.png", "normal.png")]
    albedo, normal = (read_beside(path, view) for path in files if path is not None)
    image = read_beside(view.image, view)
    covered = alpha_of(normal)
    directions = (2 * normal.pixels[..., :3] - 1) * covered + np.array(BEHIND) * (1 - covered)
    return _True(
        image=over_white(image.pixels, alpha_of(image)),
        albedo=over_white(albedo.pixels, alpha_of(albedo)),
        normal=_unit(directions),
        mask=alpha_of(image)[..., 0] > 0,
    )


def _check(run: Run) -> None:
    if not run.has_material:
        raise UserError(f"{run.path}: there is no material at step {run.step}", "train the next stage")
    if run.capture.hdr:
        raise UserError(
            f"the protocol {NAME} is for display values, and the images are linear", "use --protocol neilfpp"
        )
    for view in run.capture.test_views:
        check_full_size(NAME, view)
        for name, what in (("albedo.png", "true albedo"), ("normal.png", "true normals")):
            path = view.image.with_name(name)
            if existing(run.capture.root, path) is None:
                raise missing(NAME, run.capture, view, what, str(path.relative_to(run.capture.root)))


def _measure(run: Run, rendered: Sequence[RenderedView]) -> dict[str, float]:
    true = [_true(run.capture, view) for view in run.capture.test_views]
    shown = [
        over_white(tone_map(torch.from_numpy(view.maps["rgb"])).numpy(), view.maps["opacity"])
        for view in rendered
    ]
    albedo = [over_white(view.maps["base_color"], view.maps["opacity"]) for view in rendered]
    three = _factor(albedo, true)
    figures = _of_images("render", shown, [t.image for t in true])
    for name, factor in (("albedo", three), ("albedo_single", np.repeat(three[0], 3))):
        aligned = [
            np.where(t.mask[..., None], (factor * a).clip(0, 1), 1.0)
            for a, t in zip(albedo, true, strict=True)
        ]
        error = np.mean(
            [
                np.square(a**GAMMA - t.albedo.astype(np.float64) ** GAMMA).mean()
                for a, t in zip(aligned, true, strict=True)
            ]
        )
        similar = _of_images(name, aligned, [t.albedo for t in true])
        figures |= {f"{name}_psnr": decibels(float(error)), f"{name}_ssim": similar[f"{name}_ssim"]}
    return figures | {"normal_mae_deg": _normal_error(rendered, true)}


def _factor(albedo: Sequence[np.ndarray], true: Sequence[_True]) -> Float[np.ndarray, " 3"]:
    """The factor per channel, from `VIEWS_OF_THE_FACTOR` views."""
    interval = len(true) // VIEWS_OF_THE_FACTOR
    rows = [k * interval for k in range(VIEWS_OF_THE_FACTOR)] if interval else [0]
    if not any(true[row].mask.any() for row in rows):
        raise UserError(
            f"the protocol {NAME}: no pixel of its views has alpha", "give images with an alpha channel"
        )
    estimate = np.concatenate([albedo[row][true[row].mask] for row in rows])
    return albedo_factor(estimate, np.concatenate([true[row].albedo[true[row].mask] for row in rows]))


def _of_images(name: str, estimate: Sequence[np.ndarray], truth: Sequence[np.ndarray]) -> dict[str, float]:
    """Means over views of PSNR and SSIM of the whole frame; views must have the same size."""
    pairs = list(zip(estimate, truth, strict=True))
    inner = slice(BORDER, -BORDER)
    psnr = [decibels(np.square(e.astype(np.float64) - t).mean()) for e, t in pairs]
    ssim = [ssim_map(e, t)[inner, inner].mean() for e, t in pairs]
    return {f"{name}_psnr": float(np.mean(psnr)), f"{name}_ssim": float(np.mean(ssim))}


def _normal_error(rendered: Sequence[RenderedView], true: Sequence[_True]) -> float:
    angles = []
    for view, t in zip(rendered, true, strict=True):
        opacity = view.maps["opacity"].astype(np.float64)
        normal = _unit(view.maps["normal"] * opacity + np.array(BEHIND) * (1 - opacity))
        angles.append(np.degrees(np.arccos((normal * t.normal).sum(-1).clip(-1, 1))).mean())
    return float(np.mean(angles))


TENSOIR = Protocol(
    name=NAME,
    source="Haian-Jin/TensoIR renderer.py",
    left_out="LPIPS, whose weights are downloaded; relit images, which neilfpp relight --truth measures",
    check=_check,
    measure=_measure,
)
