"""The protocol of Stanford-ORB.

Source: StanfordORB/Stanford-ORB, `orb/utils/metrics.py`, `orb/utils/test.py` and `orb/utils/preprocess.py`.

The capture is a folder of `blender_HDR`; masks of the test views are in its `test_mask`. The other truth is
in `ground_truth/<capture>`, two folders above the capture: `pseudo_gt_albedo/<view>.png`,
`surface_normal/<view>.npy` and `z_depth/<view>.npy`. Figures whose truth is missing are left out.

Details of the protocol:

- Everything is measured at a quarter of the size of the files, 512² instead of 2048²; the truth is averaged
  over areas.
- Masks are eroded with a window of 5 × 5 pixels. Images are black outside of the mask, and the error is
  averaged over the whole frame.
- PSNR-H: negative values of the truth are set to 0. Both images are multiplied by (mean of the sRGB-encoded
  truth) / (mean of the truth), both means over the frame with values clipped to [0, 1], and then clipped to
  [0, 4]. PSNR-L: both images are clipped to [0, 1] and encoded as sRGB.
- A PSNR is at least that of an image which is 0.5 everywhere in the mask.
- New views are compared without alignment. Albedo is multiplied by the least-squares factor per image and
  channel, clipped to [0, 1], and compared in linear values; the file of the true albedo is sRGB-encoded.
- SSIM is 1 − 2 · mean(clip((1 − s)/2, 0, 1)), with a window of 3 pixels and a mirrored border.
- The error of normals is 1 − cosine, with normals in the camera frame: x right, y up, z towards the viewer.
- Depth along the axis of the camera is multiplied by one least-squares factor for all views; its squared
  error is averaged over the whole frame, in the unit of the true depth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float

from neilfpp_method.data.cameras.projection import camera_rays
from neilfpp_method.data.capture import Capture
from neilfpp_method.data.files.images import read_image
from neilfpp_method.data.scaling import file_size
from neilfpp_method.data.views import View
from neilfpp_method.errors import UserError
from neilfpp_method.evaluate.metrics import align_scale, decibels
from neilfpp_method.evaluate.published.protocol import Protocol, missing
from neilfpp_method.evaluate.published.similarity import ssim_map
from neilfpp_method.evaluate.published.truth_files import existing, read_array
from neilfpp_method.evaluate.views import RenderedView
from neilfpp_method.shading.color import linear_to_srgb, srgb_to_linear
from neilfpp_method.train.run import Run, check_material

__all__ = ["STANFORD_ORB", "albedo_scores", "eroded", "image_scores", "normal_distance"]

NAME = "stanford-orb"
SIDE = 512
"""Width and height at which views are measured, pixels (official code)."""
LARGEST_HDR = 4.0
"""Value at which PSNR-H clips (official code)."""
GRAY = 0.5
"""Value of the constant image whose PSNR is the lower bound (official code)."""
EPSILON = 1e-6
"""Smallest length of a normal, and smallest energy of a depth map (official code)."""
GL_FROM_CV = np.diag([1.0, -1.0, -1.0])
"""Camera axes of OpenGL from those of OpenCV."""

Image = Float[np.ndarray, "H W 3"]
Mask = Float[np.ndarray, "H W"]


def eroded(mask: Mask) -> Mask:
    """1 if all pixels of the surrounding 5 × 5 window are in the mask, else 0.

    Pixels beyond the border of the image count as in the mask.
    """
    bits = np.where(mask > 0.5, 255, 0).astype(np.uint8)
    return (cv2.erode(bits, np.ones((5, 5), np.uint8)) > 127).astype(np.float32)


def image_scores(name: str, estimate: Image, truth: Image, mask: Mask) -> dict[str, float]:
    """PSNR-H, PSNR-L and SSIM of linear images without alignment. The mask is eroded here."""
    inner = eroded(mask)[..., None]
    image, true = estimate * inner, np.maximum(truth * inner, 0)
    low = true.clip(0, 1)
    gain = _srgb(low).mean() / low.mean() if low.mean() > 1e-8 else 1.0
    hdr = _floored((image * gain).clip(0, LARGEST_HDR), (true * gain).clip(0, LARGEST_HDR), inner)
    display, true_display = _srgb(image.clip(0, 1)), _srgb(low)
    return {
        f"{name}_psnr_h": hdr,
        f"{name}_psnr_l": _floored(display, true_display, inner),
        f"{name}_ssim": _ssim(display, true_display),
    }


def albedo_scores(estimate: Image, truth: Image, mask: Mask) -> dict[str, float]:
    """PSNR and SSIM of linear albedo after the least-squares factor per channel. The mask is eroded here."""
    inner = eroded(mask)[..., None]
    albedo, true = estimate * inner, np.maximum(truth * inner, 0)
    pixels = inner[..., 0] > 0.5
    aligned = (albedo * align_scale(albedo[pixels], true[pixels])).clip(0, 1)
    true = true.clip(0, 1)
    return {"albedo_psnr": _floored(aligned, true, inner), "albedo_ssim": _ssim(aligned, true)}


def normal_distance(estimate: Image, truth: Image, mask: Mask) -> float:
    """Mean of 1 − cosine over the eroded mask."""
    a, b = (v / (np.linalg.norm(v, axis=-1, keepdims=True) + EPSILON) for v in (estimate, truth))
    inner = eroded(mask)
    return float(((1 - (a * b).sum(-1)) * inner).sum() / inner.sum())


def _floored(estimate: Image, truth: Image, inner: Float[np.ndarray, "H W 1"]) -> float:
    """PSNR over the frame, at least that of a grey image in the mask."""
    error, gray = (np.square(e - truth, dtype=np.float64).mean() for e in (estimate, GRAY * inner))
    return decibels(float(min(error, gray)))


def _ssim(estimate: Image, truth: Image) -> float:
    dissimilarity = ((1 - ssim_map(estimate, truth, 3, "mirror")) / 2).clip(0, 1)
    return float(1 - 2 * dissimilarity.mean())


def _srgb(linear: Image) -> Image:
    return linear_to_srgb(torch.from_numpy(np.ascontiguousarray(linear, np.float32))).numpy()


# ------------------------------------------------------------------------------------------------------ truth


def _ground_truth(capture: Capture, folder: str, name: str) -> Path | None:
    root = capture.root.resolve()
    return existing(root.parent.parent, root.parent.parent / "ground_truth" / root.name / folder / name)


def _mask_file(view: View) -> Path:
    folder = view.image.parent
    return folder.with_name(f"{folder.name}_mask") / f"{view.image.stem}.png"


def _quarter(values: Float[np.ndarray, "_ _ ..."]) -> Float[np.ndarray, "_ _ ..."]:
    return cv2.resize(values, (SIDE, SIDE), interpolation=cv2.INTER_AREA)


def _picture(path: Path, view: View) -> Float[np.ndarray, "H W C"]:
    """Read an image that must have the size of the view's files, and reduce it to `SIDE` by area averages."""
    pixels = read_image(path).pixels
    if pixels.shape[1::-1] != file_size(view):
        raise UserError(
            f"{path}: {pixels.shape[1]}×{pixels.shape[0]} pixels, a different size than the view's image",
            "download it again",
        )
    smaller = _quarter(pixels)
    return smaller if smaller.ndim == 3 else smaller[..., None]


def _check(run: Run) -> None:
    check_material(run)
    if not run.capture.hdr:
        raise UserError(f"the protocol {NAME} is for linear images", "train on a folder of blender_HDR")
    for view in run.capture.test_views:
        width, height = file_size(view)
        if width != height or (view.camera.width, view.camera.height) != (SIDE, SIDE):
            raise UserError(
                f"the protocol {NAME} measures square views at {SIDE}×{SIDE} pixels, and view {view.name} "
                f"has {view.camera.width}×{view.camera.height}",
                "leave --scale and --width out, and give the dataset's files",
            )
        path = _mask_file(view)
        if existing(run.capture.root, path) is None:
            raise missing(NAME, run.capture, view, "a mask", str(path.relative_to(run.capture.root)))


# ---------------------------------------------------------------------------------------------------- figures


@dataclass(frozen=True)
class _Depths:
    """Depth of a view along the axis of its camera: estimate, scene units, truth, and the eroded mask."""

    estimate: Float[np.ndarray, "H W"]
    truth: Float[np.ndarray, "H W"]
    mask: Mask


def _measure(run: Run, rendered: Sequence[RenderedView]) -> dict[str, float]:
    capture = run.capture
    scores: dict[str, list[float]] = {}
    depths: list[_Depths] = []
    for view, estimate in zip(capture.test_views, rendered, strict=True):
        mask = (_picture(_mask_file(view), view)[..., 0] > 0.5).astype(np.float32)
        if not eroded(mask).any():
            raise UserError(f"{_mask_file(view)}: the eroded mask is empty", "download it again")
        opacity = estimate.maps["opacity"]
        figures = image_scores("render", estimate.maps["rgb"], _picture(view.image, view)[..., :3], mask)
        if path := _ground_truth(capture, "pseudo_gt_albedo", f"{view.image.stem}.png"):
            truth = srgb_to_linear(torch.from_numpy(_picture(path, view)[..., :3])).numpy()
            figures |= albedo_scores(estimate.maps["base_color"], truth, mask)
        full = file_size(view)[::-1]
        rotation = GL_FROM_CV @ view.camera.w2c[:3, :3]
        if path := _ground_truth(capture, "surface_normal", f"{view.image.stem}.npy"):
            normal = (estimate.maps["normal"] * opacity) @ rotation.T
            figures["normal_distance"] = normal_distance(normal, _quarter(read_array(path, (*full, 3))), mask)
        if path := _ground_truth(capture, "z_depth", f"{view.image.stem}.npy"):
            depth = _along_axis(capture, view, estimate)
            depths.append(_Depths(depth, _quarter(read_array(path, full)), eroded(mask)))
        for name, value in figures.items():
            scores.setdefault(name, []).append(value)
    means = {name: float(np.mean(values)) for name, values in scores.items()}
    return means | ({"depth_mse": _depth_error(depths)} if depths else {})


def _along_axis(capture: Capture, view: View, rendered: RenderedView) -> Float[np.ndarray, "H W"]:
    """Depth along the axis of the camera, scene units, from the depth along the rays."""
    camera = capture.scene_camera(view)
    cosine = camera_rays(camera).directions.double().numpy() @ camera.w2c[2, :3]
    return rendered.maps["depth"][..., 0] * cosine.reshape(SIDE, SIDE).astype(np.float32)


def _depth_error(depths: Sequence[_Depths]) -> float:
    """Mean over views of the squared error of depth, averaged over the frame of each.

    An estimate that is 0 in the whole mask of a view is replaced by 1, as in the official code.
    """
    filled = [
        replace(view, estimate=np.ones_like(view.estimate))
        if np.square(view.estimate[view.mask > 0.5]).sum() <= EPSILON
        else view
        for view in depths
    ]
    product = sum(_sum_in_mask(view.truth * view.estimate, view.mask) for view in filled)
    energy = sum(_sum_in_mask(np.square(view.estimate), view.mask) for view in filled)
    factor = product / energy
    errors = (np.square(factor * view.estimate - view.truth) * view.mask for view in filled)
    return float(np.mean([error.mean(dtype=np.float64) for error in errors]))


def _sum_in_mask(values: Float[np.ndarray, "H W"], mask: Mask) -> float:
    return float(values[mask > 0.5].sum(dtype=np.float64))


STANFORD_ORB = Protocol(
    name=NAME,
    source="StanfordORB/Stanford-ORB orb/utils/metrics.py",
    left_out=(
        "LPIPS, whose weights must be downloaded; relit images, which neilfpp relight --truth measures; "
        "the Chamfer distance of the scan"
    ),
    check=_check,
    measure=_measure,
    side=SIDE,
)
