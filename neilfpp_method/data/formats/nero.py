"""Reader of NeRO's glossy synthetic scenes.

    <i>-camera.pkl    a pickled pair of arrays: world to camera, 3×4, OpenCV axes; and the intrinsic matrix,
                        3×3, with pixel centres at +½
    <i>.png           the image; i is 0, 1, … without gaps

The object lies in the unit sphere. NeRO's real scenes are COLMAP models in colmap/sparse/0, which `colmap`
reads.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from neilfpp_method.data.cameras.camera import Camera
from neilfpp_method.data.files.images import image_header
from neilfpp_method.data.files.paths import inside
from neilfpp_method.data.formats.pickled_arrays import read_pickled_arrays
from neilfpp_method.data.formats.places import stored_image
from neilfpp_method.data.views import CaptureFiles, Normalization, View
from neilfpp_method.errors import UserError

__all__ = ["LAYOUT", "read", "recognize"]

LAYOUT = "0-camera.pkl, 0.png and so on"
SUFFIX = "-camera.pkl"
MAX_SKEW = 1e-3
"""Largest ratio of skew to focal length that counts as rounding."""


def recognize(root: Path) -> bool:
    """Whether the folder has the first camera."""
    return (root / f"0{SUFFIX}").is_file()


def read(root: Path) -> CaptureFiles:
    """Read the files of the capture.

    Raises:
        UserError: a camera or an image is missing, or a camera is malformed.
    """
    count = sum(1 for path in root.glob(f"*{SUFFIX}") if path.name.removesuffix(SUFFIX).isdigit())
    return CaptureFiles(
        root, tuple(_view(root, i) for i in range(count)), Normalization(1.0, (0.0, 0.0, 0.0))
    )


def _view(root: Path, i: int) -> View:
    path = inside(root, root / f"{i}{SUFFIX}")
    arrays = read_pickled_arrays(path)
    if [array.shape for array in arrays] != [(3, 4), (3, 3)] or not all(
        np.isfinite(array).all() for array in arrays
    ):
        raise UserError(
            f"{path}: not a pose of 3×4 and intrinsics of 3×3 finite numbers", "write the camera again"
        )
    pose, k = arrays
    if abs(k[0, 1]) > MAX_SKEW * abs(k[0, 0]) or not np.allclose(k[[1, 2, 2, 2], [0, 0, 1, 2]], [0, 0, 0, 1]):
        raise UserError(f"{path}: the intrinsics are not those of a pinhole", "undistort the images")
    image = stored_image(root, root / f"{i}.png", str(path))
    header = image_header(image)
    w2c = np.concatenate([pose, [[0.0, 0.0, 0.0, 1.0]]])
    fx, fy, cx, cy = (float(k[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
    return View(str(i), i, Camera(fx, fy, cx, cy, header.width, header.height, w2c), image)
