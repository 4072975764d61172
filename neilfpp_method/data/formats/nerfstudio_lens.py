"""Conversion of lens coefficients between nerfstudio's names (k1 to k4, p1, p2) and COLMAP's models."""

from __future__ import annotations

from collections.abc import Mapping

from neilfpp_method.data.cameras.camera import Camera
from neilfpp_method.data.cameras.lens import Lens, lens_of
from neilfpp_method.errors import UserError

__all__ = ["COEFFICIENTS", "FISHEYE", "lens_from_nerfstudio", "nerfstudio_coefficients"]

FISHEYE = "OPENCV_FISHEYE"
COEFFICIENTS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
"""Coefficients that a transforms.json may have."""
NAMES = {
    "SIMPLE_RADIAL": ("k1",),
    "RADIAL": ("k1", "k2"),
    "OPENCV": ("k1", "k2", "p1", "p2"),
    "FULL_OPENCV": ("k1", "k2", "p1", "p2", "k3"),
    FISHEYE: ("k1", "k2", "k3", "k4"),
}
"""Nerfstudio's names of the leading coefficients of COLMAP's models; the others have no name there."""


def lens_from_nerfstudio(model: str, coefficients: Mapping[str, float], where: str) -> Lens | None:
    """Return the lens of a camera model; None if it has no distortion.

    Args:
        model: `FISHEYE`, or any other name for a perspective camera.
        coefficients: coefficients by name; missing ones are 0.
        where: the camera, for the message.

    Raises:
        UserError: a coefficient has no counterpart in COLMAP. The k4 of nerfstudio's perspective camera
            multiplies r⁸, which no model of COLMAP has; k5 and k6 have no meaning in nerfstudio.
    """
    known = {name: coefficients.get(name, 0.0) for name in COEFFICIENTS}
    for name in ("k5", "k6") if model == FISHEYE else ("k4", "k5", "k6"):
        if known[name]:
            raise UserError(
                f"{where}: {name} is not supported for the camera model {model}",
                "undistort the images, or calibrate without it",
            )
    if model != FISHEYE:
        model = "FULL_OPENCV" if known["k3"] else "OPENCV"
    unnamed = (0.0,) * 3 if model == "FULL_OPENCV" else ()
    return lens_of(model, (*(known[name] for name in NAMES[model]), *unnamed))


def nerfstudio_coefficients(camera: Camera) -> Mapping[str, float] | None:
    """Return lens coefficients by name: empty for a pinhole, None for a lens that nerfstudio lacks."""
    if camera.lens is None:
        return {}
    names, coefficients = NAMES.get(camera.lens.model), camera.lens.coefficients
    if names is None or any(coefficients[len(names) :]):
        return None
    return dict(zip(names, coefficients, strict=False))
