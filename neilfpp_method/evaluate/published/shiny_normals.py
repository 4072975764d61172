"""The error of normals of Ref-NeRF on Shiny Blender: google-research/multinerf, `ref_utils.py`.

Details of the protocol:

- The weight of a pixel is the estimate's opacity times the alpha of the true image; there is no hard mask.
- Cosines are clipped to ±(1 − 2⁻²³), so a perfect estimate has an error of 0.028°, not 0.
- The mean is computed per view and averaged over the views.
- True normals are 8-bit images beside the photographs, `<image>_normal.png`, with n = 2 p / 255 − 1 in the
  world frame. A capture in the layout of the NeILF datasets has float normals instead, and its depth maps
  define the alpha.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from neilfpp_method.data.capture import Capture
from neilfpp_method.data.files.images import read_image
from neilfpp_method.data.files.paths import inside
from neilfpp_method.data.scaling import file_size
from neilfpp_method.data.truth import Truth
from neilfpp_method.data.views import View
from neilfpp_method.errors import UserError
from neilfpp_method.evaluate.published.protocol import Protocol, missing, no_surface
from neilfpp_method.evaluate.views import RenderedView
from neilfpp_method.train.run import Run

__all__ = ["SHINY_NORMALS", "weighted_angle"]

NAME = "shiny-normals"
MAX_COSINE = 1 - 2.0**-23
"""1 minus the spacing of float32 at 1."""


def weighted_angle(
    estimate: Float[np.ndarray, "H W 3"], truth: Float[np.ndarray, "H W 3"], weight: Float[np.ndarray, "H W"]
) -> float:
    """Weighted mean angle between normals, degrees (`compute_weighted_mae`); NaN if all weights are 0."""
    cosine = (_unit(estimate) * _unit(truth)).sum(-1).clip(-MAX_COSINE, MAX_COSINE)
    total = weight.sum(dtype=np.float64)
    return float(np.degrees((weight * np.arccos(cosine)).sum() / total)) if total > 0 else float("nan")


def _unit(normal: Float[np.ndarray, "H W 3"]) -> Float[np.ndarray, "H W 3"]:
    squared = np.square(normal.astype(np.float64)).sum(-1, keepdims=True)
    return normal / np.sqrt(np.maximum(squared, 2.0**-23))


@dataclass(frozen=True)
class _True:
    """True normals of a view, world or scene frame, whose axes are the same; and the alpha of its image."""

    normal: Float[np.ndarray, "H W 3"]
    alpha: Float[np.ndarray, "H W"]


def _true(capture: Capture, view: View) -> _True | None:
    """The truth of a view; None if there are no true normals."""
    width, height = view.camera.width, view.camera.height
    path = view.image.with_name(f"{view.image.stem}_normal.png")
    if inside(capture.root, path).is_file():
        if (width, height) != file_size(view):
            raise UserError(
                f"{path}: true normals in 8 bits cannot be resized", "leave --scale and --width out"
            )
        pixels, alpha = read_image(path).pixels, read_image(view.image).alpha
        if pixels.shape != (height, width, 3):
            raise UserError(
                f"{path}: has shape {pixels.shape}, but the view needs {(height, width, 3)}",
                "render it again",
            )
        return _True(2 * pixels - 1, np.ones((height, width)) if alpha is None else alpha)
    truth = Truth(capture)
    normal, mask = truth.normal(view), truth.mask(view)
    if normal is None or mask is None:
        return None
    return _True(normal.view(height, width, 3).numpy(), mask.view(height, width).numpy().astype(np.float64))


def _check(run: Run) -> None:
    for view in run.capture.test_views:
        if _true(run.capture, view) is None:
            beside = view.image.with_name(f"{view.image.stem}_normal.png").relative_to(run.capture.root)
            neilf = f"inputs/normal_maps/{view.name}.exr and inputs/depth_maps/{view.name}.exr"
            place = f"{beside}, or in the NeILF layout at {neilf}"
            raise missing(NAME, run.capture, view, "true normals", place)


def _measure(run: Run, rendered: Sequence[RenderedView]) -> dict[str, float]:
    angles = []
    for view, estimate in zip(run.capture.test_views, rendered, strict=True):
        true = _true(run.capture, view)
        weight = estimate.maps["opacity"][..., 0] * true.alpha
        angles.append(weighted_angle(estimate.maps["normal"], true.normal, weight))
    angles = [angle for angle in angles if not np.isnan(angle)]
    if not angles:
        raise no_surface(run)
    return {"normal_mae_deg": float(np.mean(angles))}


SHINY_NORMALS = Protocol(
    name=NAME,
    source="google-research/multinerf eval.py",
    left_out="figures of images; LPIPS among them needs weights that must be downloaded",
    check=_check,
    measure=_measure,
)
