"""Lenses that bend straight lines: COLMAP's camera models between the pinhole's image plane and the real one.

Both planes are at unit distance: the pinhole's point (x/z, y/z), and the point where the lens shows it, which
becomes a pixel by focal length and principal point. pycolmap computes both directions, so a model means here
what it means there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from neilfpp_method.data.colmap_library import pycolmap
from neilfpp_method.errors import UserError

__all__ = ["PANORAMAS", "PINHOLES", "Lens", "lens_of"]

PINHOLES = frozenset({"SIMPLE_PINHOLE", "PINHOLE"})
PANORAMAS = frozenset({"INVALID", "EQUIRECTANGULAR"})
LENSES = tuple(name for name in pycolmap.CameraModelId.__members__ if name not in PINHOLES | PANORAMAS)
# Models that bend nothing when all coefficients are 0; a fisheye does even then.
STRAIGHT_AT_ZERO = frozenset(
    {"SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "SIMPLE_DIVISION", "DIVISION"}
)


@dataclass(frozen=True)
class Lens:
    """A COLMAP camera model without its focal length and principal point.

    `model` is COLMAP's name ("OPENCV", "OPENCV_FISHEYE", …), `coefficients` its further parameters in order.
    """

    model: str
    coefficients: tuple[float, ...]

    def bend(self, plane: Float64[np.ndarray, "N 2"]) -> Float64[np.ndarray, "N 2"]:
        """From the pinhole's plane to the lens's; NaN where the lens shows nothing."""
        points = np.pad(plane, ((0, 0), (0, 1)), constant_values=1.0)
        return np.asarray(self.camera().img_from_cam(points), dtype=np.float64).reshape(-1, 2)

    def straighten(self, plane: Float64[np.ndarray, "N 2"]) -> Float64[np.ndarray, "N 2"]:
        """The inverse of `bend`; NaN where no ray in front of the camera reaches the point."""
        straight = np.asarray(self.camera().cam_from_img(plane), dtype=np.float64).reshape(-1, 2)
        missed = np.abs(self.bend(straight) - plane).max(axis=1, initial=0.0) > 1e-5
        return np.where(missed[:, None], np.nan, straight)

    def check(self, where: str) -> None:
        """Refuse a model that is not known, or has another number of coefficients.

        Raises:
            UserError: names `where`.
        """
        if self.model not in LENSES:
            raise UserError(f"{where}: unknown lens model '{self.model}'", f"use one of {', '.join(LENSES)}")
        count = len(pycolmap.Camera.create_from_model_name(0, self.model, 1.0, 1, 1).extra_params_idxs())
        if len(self.coefficients) != count or not np.isfinite(self.coefficients).all():
            raise UserError(
                f"{where}: the lens {self.model} has {count} finite coefficients", "correct the camera"
            )

    def camera(
        self,
        focal: tuple[float, float] = (1.0, 1.0),
        centre: tuple[float, float] = (0.0, 0.0),
        size: tuple[int, int] = (1, 1),
    ) -> pycolmap.Camera:
        """pycolmap's camera with this lens; a model with one focal length takes the mean of the two."""
        camera = pycolmap.Camera.create_from_model_name(0, self.model, 1.0, *size)
        params, focals = np.zeros(len(camera.params)), list(camera.focal_length_idxs())
        params[focals] = focal if len(focals) == 2 else np.mean(focal)
        params[list(camera.principal_point_idxs())] = centre
        params[list(camera.extra_params_idxs())] = self.coefficients
        camera.params = params
        return camera


def lens_of(model: str, coefficients: Sequence[float]) -> Lens | None:
    """The lens of a COLMAP model; none where it is a pinhole's, by name or because it bends nothing."""
    if model in PINHOLES or (model in STRAIGHT_AT_ZERO and not any(coefficients)):
        return None
    return Lens(model, tuple(map(float, coefficients)))
