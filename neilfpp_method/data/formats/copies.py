"""Copy images, masks and points of a capture, for the writers of other layouts."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32

from neilfpp_method.data.cameras.camera import Camera
from neilfpp_method.data.cameras.undistort import resample, straight_camera
from neilfpp_method.data.files.atomic_file import replacing
from neilfpp_method.data.files.images import read_image, write_exr, write_png
from neilfpp_method.data.views import View
from neilfpp_method.errors import UserError
from neilfpp_method.shading.color import linear_to_srgb, srgb_to_linear

__all__ = ["copy_file", "copy_view", "writing"]

MASK_THRESHOLD = 0.5
"""Value of an interpolated mask above which a pixel is on the object: most of it is."""
VALID_THRESHOLD = 0.9995
"""Value of an interpolated validity mask above which all neighbours are valid. It is slightly below 1 because
OpenCV's interpolation weights are multiples of 1/1024."""


@contextmanager
def writing(out: Path) -> Iterator[None]:
    """Create the folder `out` and turn errors of the operating system in the block into a `UserError`."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        yield
    except OSError as error:
        raise UserError(
            f"{out}: cannot be written ({error.strerror or error})", "choose another folder"
        ) from error


def copy_view(view: View, out: Path, hdr: bool, straight: bool) -> View:
    """Copy the files of a view to `out`/images, `out`/masks and `out`/valid and return the new view.

    Files are copied unchanged if possible. An exposure or a white balance is divided out, because other
    layouts have no such factors, and the image is written as EXR. If `straight` is true, the image is
    resampled to a pinhole in linear radiance and written as EXR, or as 16-bit PNG if the capture is not
    linear. A resampled pixel is valid if all pixels that it is interpolated from are valid, and on the object
    if most of it is.

    Args:
        view: the view.
        out: the target folder.
        hdr: whether pixels are linear radiance.
        straight: whether to remove lens distortion.

    Raises:
        UserError: an image cannot be read.
    """
    camera = straight_camera(view.camera) if straight else view.camera
    factor = view.exposure * np.array(view.white_balance, np.float32)
    unchanged = camera is view.camera and bool((factor == 1.0).all())
    if unchanged:
        image = copy_file(view.image, out / "images" / f"{view.name}{view.image.suffix.lower()}")
    else:
        image = _write_image(view, camera, factor, hdr, out / "images" / view.name)
    name = f"{view.name}.png"
    return replace(
        view,
        camera=camera,
        image=image,
        mask=_copy_mask(view.mask, view.camera, camera, out / "masks" / name, MASK_THRESHOLD),
        valid=_copy_mask(view.valid, view.camera, camera, out / "valid" / name, VALID_THRESHOLD),
        exposure=1.0,
        white_balance=(1.0, 1.0, 1.0),
    )


def copy_file(source: Path, target: Path) -> Path:
    """Copy a file atomically and return the target."""
    with replacing(target) as temporary:
        shutil.copyfile(source, temporary)
    return target


def _write_image(
    view: View, camera: Camera, factor: Float32[np.ndarray, " 3"], hdr: bool, target: Path
) -> Path:
    image = read_image(view.image)
    linear = image.pixels if hdr else srgb_to_linear(torch.from_numpy(image.pixels)).numpy()
    color = np.broadcast_to(linear, (*linear.shape[:2], 3)) / factor
    layers = color if image.alpha is None else np.concatenate([color, image.alpha[..., None]], axis=-1)
    layers = np.ascontiguousarray(layers, np.float32)
    if camera is not view.camera:
        layers = resample(layers, view.camera, camera)
    if hdr:
        path = target.with_name(f"{target.name}.exr")
        write_exr(path, {"RGB" if layers.shape[2] == 3 else "RGBA": layers})
        return path
    layers[..., :3] = linear_to_srgb(torch.from_numpy(layers[..., :3])).numpy()
    path = target.with_name(f"{target.name}.png")
    write_png(path, np.rint(layers.clip(0, 1) * 65_535).astype(np.uint16))
    return path


def _copy_mask(
    mask: Path | None, camera: Camera, straight: Camera, target: Path, threshold: float
) -> Path | None:
    """Copy a mask; a resampled pixel is white if its interpolated value is above `threshold`."""
    if mask is None:
        return None
    if camera is straight and mask.suffix.lower() == ".png":
        return copy_file(mask, target)
    white = (read_image(mask).mask[..., None] > 0.5).astype(np.float32)
    moved = white if camera is straight else resample(white, camera, straight)
    write_png(target, np.where(moved > threshold, 255, 0).astype(np.uint8))
    return target
