"""Lens distortion by COLMAP's camera models.

Distortion maps a point of the undistorted image plane, (x/z, y/z), to a point of the distorted one, which
becomes a pixel by focal length and principal point. pycolmap computes both directions, so that models and
coefficients have exactly COLMAP's meaning.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from neilfpp_method.data.cameras.colmap_library import pycolmap
from neilfpp_method.errors import UserError

__all__ = ["PANORAMAS", "PINHOLES", "Lens", "lens_of"]

PINHOLES = frozenset({"SIMPLE_PINHOLE", "PINHOLE"})
PANORAMAS = frozenset({"INVALID", "EQUIRECTANGULAR"})
LENSES = tuple(name for name in pycolmap.CameraModelId.__members__ if name not in PINHOLES | PANORAMAS)
STRAIGHT_AT_ZERO = frozenset(
    {"SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "SIMPLE_DIVISION", "DIVISION"}
)
"""Models without distortion when all coefficients are 0; fisheye models distort even then."""


@dataclass(frozen=True)
class Lens:
    """A COLMAP camera model without its focal length and principal point.

    Attributes:
        model: COLMAP's name of the model ("OPENCV", "OPENCV_FISHEYE", …).
        coefficients: its other parameters, in COLMAP's order.
    """

    model: str
    coefficients: tuple[float, ...]

    def bend(self, plane: Float64[np.ndarray, "N 2"]) -> Float64[np.ndarray, "N 2"]:
        """Distort points of the image plane; NaN for points that the lens does not show."""
        points = np.pad(plane, ((0, 0), (0, 1)), constant_values=1.0)
        return np.asarray(self.camera().img_from_cam(points), dtype=np.float64).reshape(-1, 2)

    def straighten(self, plane: Float64[np.ndarray, "N 2"]) -> Float64[np.ndarray, "N 2"]:
        """Undistort points, the inverse of `bend`; NaN where no ray from the front reaches the point."""
        straight = np.asarray(self.camera().cam_from_img(plane), dtype=np.float64).reshape(-1, 2)
        missed = np.abs(self.bend(straight) - plane).max(axis=1, initial=0.0) > 1e-5
        return np.where(missed[:, None], np.nan, straight)

    def check(self, where: str) -> None:
        """Check that the model is known and has the right number of coefficients.

        Raises:
            UserError: it is not; the message names `where`.
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
        center: tuple[float, float] = (0.0, 0.0),
        size: tuple[int, int] = (1, 1),
    ) -> pycolmap.Camera:
        """Return a camera of pycolmap with this lens; for a model with one focal length, it is the mean."""
        camera = pycolmap.Camera.create_from_model_name(0, self.model, 1.0, *size)
        params, focals = np.zeros(len(camera.params)), list(camera.focal_length_idxs())
        params[focals] = focal if len(focals) == 2 else np.mean(focal)
        params[list(camera.principal_point_idxs())] = center
        params[list(camera.extra_params_idxs())] = self.coefficients
        camera.params = params
        return camera


def lens_of(model: str, coefficients: Sequence[float]) -> Lens | None:
    """Return the lens of a COLMAP model; None for a pinhole and for a model whose coefficients are all 0."""
    if model in PINHOLES or (model in STRAIGHT_AT_ZERO and not any(coefficients)):
        return None
    return Lens(model, tuple(map(float, coefficients)))
