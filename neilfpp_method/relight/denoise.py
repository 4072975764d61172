"""Denoise path-traced images with Intel Open Image Denoise (Áfra), if `pyoidn` is installed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from neilfpp_method.errors import UserError
from neilfpp_method.relight.film import Picture

__all__ = ["check_denoiser", "denoised"]


def check_denoiser() -> None:
    """Check that the denoiser is installed.

    Raises:
        UserError: it is not.
    """
    _library()


def denoised(picture: Picture) -> Picture:
    """Denoise the radiance of an image, guided by its reflectance and normals. Alpha does not change.

    Raises:
        UserError: the denoiser is not installed, or it fails.
    """
    oidn = _library()
    color, albedo, normal = (
        np.ascontiguousarray(part.cpu().numpy(), np.float32)
        for part in (picture.radiance, picture.albedo, picture.normal)
    )
    result = np.empty_like(color)
    with oidn.Device(oidn.OIDN_DEVICE_TYPE_CPU) as device:
        device.commit()
        filter = oidn.Filter(device, oidn.OIDN_FILTER_TYPE_RT)
        try:
            images = {
                oidn.OIDN_IMAGE_COLOR: color,
                oidn.OIDN_IMAGE_ALBEDO: albedo,
                oidn.OIDN_IMAGE_NORMAL: normal,
                oidn.OIDN_IMAGE_OUTPUT: result,
            }
            for name, image in images.items():
                filter.set_image(name, image, oidn.OIDN_FORMAT_FLOAT3)
            filter.set_bool("hdr", True)
            filter.commit()
            filter.execute()
        finally:
            filter.release()
        failure = device.get_error()
    if failure is not None:
        raise UserError(f"the denoiser failed ({failure})", "leave --denoise out")
    return replace(picture, radiance=torch.from_numpy(result).to(picture.radiance))


def _library():
    try:
        import pyoidn
    except ImportError as error:
        remedy = "pip install 'neilfpp-method[denoise]', or leave --denoise out and give more --spp"
        raise UserError("--denoise needs pyoidn, which is not installed", remedy) from error
    return pyoidn
