"""The protocol of TensoIR on TensoIR-Synthetic.

Source: Haian-Jin/TensoIR, `renderer.py` (`evaluation_iter_TensoIR`, `compute_rescale_ratio`),
`dataLoader/tensoIR_rotation_setting.py` and `utils.py` (`rgb_ssim`).

The layout is that of the dataset: a folder for each view with `rgba_<light>.png`, `albedo.png` and
`normal.png`.

Details of the protocol:

- Images and albedo are composited over white, the truth with its alpha and the estimate with its opacity.
  PSNR and SSIM are over the whole frame. White background is free of error, so a small object scores higher.
- Albedo is multiplied by a factor per channel: the median of truth / estimate over the pixels of 20 views at
  which the truth has an alpha above 0. The views are k · ⌊n/20⌋; with fewer than 20 test views, only the
  first is used. The median of an even number of values is the lower of the middle two. `_single` uses the
  factor of red for all channels.
- The scaled albedo is clipped to [0, 1]; pixels at which the truth has alpha 0 are white.
- PSNR of albedo is that of one squared error over all views, with both raised to the power 1/2.2. SSIM of
  albedo is computed per view, without that power.
- The background counts in the error of normals: the truth is (0, 0, 1) there, and the estimate is blended
  with (0, 0, 1) according to its transparency. The mean is over all pixels of all views.
- SSIM leaves out the 5 pixels at the border, at which its window of 11 pixels reaches beyond the image.
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
from neilfpp_method.evaluate.metrics import decibels
from neilfpp_method.evaluate.published.protocol import Protocol, missing
from neilfpp_method.evaluate.published.similarity import ssim_map
from neilfpp_method.evaluate.published.truth_files import alpha_of, check_full_size, existing, read_beside
from neilfpp_method.evaluate.views import RenderedView
from neilfpp_method.shading.color import tone_map
from neilfpp_method.train.run import Run, check_material

__all__ = ["TENSOIR", "albedo_factor", "over_white"]

NAME = "tensoir"
GAMMA = 1 / 2.2
"""Exponent for the PSNR of albedo (official code)."""
VIEWS_OF_THE_FACTOR = 20
"""Number of views from which the factor of albedo is computed (official code)."""
MIN_ESTIMATE = 1e-6
"""Lower bound of the estimated albedo in a division (official code)."""
BORDER = 5
"""Width of the border that SSIM leaves out, pixels: half of its window."""
BACKGROUND = (0.0, 0.0, 1.0)
"""Normal of the background (official code)."""


@dataclass(frozen=True)
class _True:
    """The truth of a view: image and albedo over white, unit normals, and the mask of alpha above 0."""

    image: Float[np.ndarray, "H W 3"]
    albedo: Float[np.ndarray, "H W 3"]
    normal: Float[np.ndarray, "H W 3"]
    mask: Bool[np.ndarray, "H W"]


def over_white(
    color: Float[np.ndarray, "H W 3"], alpha: Float[np.ndarray, "H W 1"]
) -> Float[np.ndarray, "H W 3"]:
    """Composite a colour over white."""
    return color * alpha + (1 - alpha)


def albedo_factor(
    estimate: Float[np.ndarray, "P 3"], truth: Float[np.ndarray, "P 3"]
) -> Float[np.ndarray, " 3"]:
    """Median of truth / estimate per channel; of an even number of values, the lower of the middle two."""
    ratio = np.sort(truth / np.maximum(estimate, MIN_ESTIMATE), axis=0)
    return ratio[(len(ratio) - 1) // 2]


def _unit(normal: Float[np.ndarray, "H W 3"]) -> Float[np.ndarray, "H W 3"]:
    return normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)


def _true(capture: Capture, view: View) -> _True:
    files = [existing(capture.root, view.image.with_name(name)) for name in ("albedo.png", "normal.png")]
    albedo, normal = (read_beside(path, view) for path in files if path is not None)
    image = read_beside(view.image, view)
    covered = alpha_of(normal)
    directions = (2 * normal.pixels[..., :3] - 1) * covered + np.array(BACKGROUND) * (1 - covered)
    return _True(
        image=over_white(image.pixels, alpha_of(image)),
        albedo=over_white(albedo.pixels, alpha_of(albedo)),
        normal=_unit(directions),
        mask=alpha_of(image)[..., 0] > 0,
    )


def _check(run: Run) -> None:
    check_material(run)
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
    images = [
        over_white(tone_map(torch.from_numpy(view.maps["rgb"])).numpy(), view.maps["opacity"])
        for view in rendered
    ]
    albedo = [over_white(view.maps["base_color"], view.maps["opacity"]) for view in rendered]
    per_channel = _factor(albedo, true)
    true_images, true_albedo = [t.image for t in true], [t.albedo for t in true]
    figures = {
        "render_psnr": float(np.mean([decibels(error) for error in _squared_errors(images, true_images)])),
        "render_ssim": _mean_ssim(images, true_images),
    }
    for name, factor in (("albedo", per_channel), ("albedo_single", np.repeat(per_channel[0], 3))):
        aligned = [
            np.where(t.mask[..., None], (factor * a).clip(0, 1), 1.0)
            for a, t in zip(albedo, true, strict=True)
        ]
        error = np.mean(
            _squared_errors([a**GAMMA for a in aligned], [t.astype(np.float64) ** GAMMA for t in true_albedo])
        )
        figures[f"{name}_psnr"] = decibels(float(error))
        figures[f"{name}_ssim"] = _mean_ssim(aligned, true_albedo)
    return figures | {"normal_mae_deg": _normal_error(rendered, true)}


def _factor(albedo: Sequence[np.ndarray], true: Sequence[_True]) -> Float[np.ndarray, " 3"]:
    """The factor per channel, from `VIEWS_OF_THE_FACTOR` views."""
    interval = len(true) // VIEWS_OF_THE_FACTOR
    rows = [k * interval for k in range(VIEWS_OF_THE_FACTOR)] if interval else [0]
    if not any(true[row].mask.any() for row in rows):
        raise UserError(
            f"the protocol {NAME}: no pixel of the views has an alpha above 0",
            "give images with an alpha channel",
        )
    estimate = np.concatenate([albedo[row][true[row].mask] for row in rows])
    return albedo_factor(estimate, np.concatenate([true[row].albedo[true[row].mask] for row in rows]))


def _squared_errors(estimate: Sequence[np.ndarray], truth: Sequence[np.ndarray]) -> list[float]:
    """Mean squared error over the whole frame of each view."""
    return [float(np.square(e.astype(np.float64) - t).mean()) for e, t in zip(estimate, truth, strict=True)]


def _mean_ssim(estimate: Sequence[np.ndarray], truth: Sequence[np.ndarray]) -> float:
    """SSIM without the border, averaged over views."""
    inner = slice(BORDER, -BORDER)
    views = zip(estimate, truth, strict=True)
    return float(np.mean([ssim_map(e, t)[inner, inner].mean() for e, t in views]))


def _normal_error(rendered: Sequence[RenderedView], true: Sequence[_True]) -> float:
    """Mean angle between normals over all pixels of all views, degrees."""
    angles = []
    for view, t in zip(rendered, true, strict=True):
        opacity = view.maps["opacity"].astype(np.float64)
        normal = _unit(view.maps["normal"] * opacity + np.array(BACKGROUND) * (1 - opacity))
        angles.append(np.degrees(np.arccos((normal * t.normal).sum(-1).clip(-1, 1))).mean())
    return float(np.mean(angles))


TENSOIR = Protocol(
    name=NAME,
    source="Haian-Jin/TensoIR renderer.py",
    left_out="LPIPS, whose weights must be downloaded; relit images, which neilfpp relight --truth measures",
    check=_check,
    measure=_measure,
)
