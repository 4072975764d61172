"""Reader of DTU scans as IDR and NeuS distribute them, and of other scenes in their layout.

    cameras_sphere.npz or cameras.npz    world_mat_<i>: projection from world to image, 4×4; the last
                                           row is not used;
                                         scale_mat_<i>: from the unit sphere to the world, a scale and a shift
    image/ or rgb/, and mask/            the i-th file in the order of the names belongs to camera i

In these files pixel centres have integer coordinates, here they are at +½, so half a pixel is added to
principal points.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from scipy.linalg import rq

from neilfpp_method.data.cameras.camera import Camera
from neilfpp_method.data.files.images import IMAGE_SUFFIXES, image_header
from neilfpp_method.data.files.number_arrays import arrays_of_archive
from neilfpp_method.data.files.paths import inside
from neilfpp_method.data.views import CaptureFiles, Normalization, View
from neilfpp_method.errors import UserError

__all__ = ["LAYOUT", "read", "recognize"]

LAYOUT = "cameras_sphere.npz or cameras.npz, and image/ or rgb/"
CAMERAS = ("cameras_sphere.npz", "cameras.npz")
IMAGES = ("image", "rgb", "images")
MASKS = ("mask", "masks")
MAX_BYTES = 2**26
"""Largest unpacked size of a camera archive, in bytes."""
MAX_SKEW = 0.05
"""Largest horizontal shift by skew across the height of an image, in pixels, that counts as rounding."""


def recognize(root: Path) -> bool:
    """Whether the folder has a camera archive and a folder of images."""
    return any((root / name).is_file() for name in CAMERAS) and any((root / name).is_dir() for name in IMAGES)


def read(root: Path) -> CaptureFiles:
    """Read the files of the capture.

    Raises:
        UserError: the archive is malformed, or images, masks and cameras do not match.
    """
    archive = inside(root, next(root / name for name in CAMERAS if (root / name).is_file()))
    try:
        matrices = arrays_of_archive(archive, MAX_BYTES)
    except ValueError as error:
        raise UserError(
            f"{archive}: not an archive of matrices ({error})", "export the cameras again"
        ) from error
    images = _files(root, next(root / name for name in IMAGES if (root / name).is_dir()))
    masks = next((_files(root, root / name) for name in MASKS if (root / name).is_dir()), ())
    cameras = sum(name.startswith("world_mat_") and "inv" not in name for name in matrices)
    if not images or len(images) != cameras or len(masks) not in (0, len(images)):
        raise UserError(
            f"{archive}: {cameras} cameras for {len(images)} images and {len(masks)} masks",
            "give one of each for every view",
        )
    views = []
    for i, image in enumerate(images):
        header = image_header(image)
        camera = _camera(
            _matrix(matrices, f"world_mat_{i}", archive), header.width, header.height, archive, i
        )
        views.append(View(image.stem, i, camera, image, masks[i] if masks else None))
    return CaptureFiles(root, tuple(views), _normalization(matrices, len(images), archive))


def _matrix(matrices: Mapping[str, np.ndarray], name: str, archive: Path) -> Float64[np.ndarray, "4 4"]:
    matrix = matrices.get(name)
    if matrix is None:
        raise UserError(
            f"{archive}: {name} is missing", "number the matrices from 0, in the order of the images' names"
        )
    if (
        matrix.shape not in ((4, 4), (3, 4))
        or matrix.dtype.kind not in "fiu"
        or not np.isfinite(matrix).all()
    ):
        raise UserError(
            f"{archive}: {name} is not a 4×4 matrix of finite numbers", "export the cameras again"
        )
    return np.concatenate([matrix[:3], [[0, 0, 0, 1]]]).astype(np.float64)


def _camera(world_mat: Float64[np.ndarray, "4 4"], width: int, height: int, archive: Path, i: int) -> Camera:
    """The pinhole of a projection matrix P = s·K·[R | t], whatever the sign of s."""
    where = f"{archive}: world_mat_{i}"
    projection = world_mat[:3] * (np.sign(np.linalg.det(world_mat[:3, :3])) or 1.0)
    upper, rotation = rq(projection[:, :3])
    signs = np.where(np.diag(upper) < 0, -1.0, 1.0)
    upper, rotation = upper * signs, signs[:, None] * rotation
    if upper[2, 2] < 1e-12 or min(upper[0, 0], upper[1, 1]) <= 0:
        raise UserError(f"{where} is not a projection matrix", "export the cameras again")
    translation = np.linalg.solve(upper, projection[:, 3])
    k = upper / upper[2, 2]
    if abs(k[0, 1]) * height / k[1, 1] > MAX_SKEW:
        raise UserError(f"{where} has pixels that are not rectangular", "undistort the images to a pinhole")
    w2c = np.eye(4)
    w2c[:3, :3], w2c[:3, 3] = rotation, translation
    fx, fy, cx, cy = (float(v) for v in (k[0, 0], k[1, 1], k[0, 2] + 0.5, k[1, 2] + 0.5))
    return Camera(fx, fy, cx, cy, width, height, w2c)


def _normalization(matrices: Mapping[str, np.ndarray], count: int, archive: Path) -> Normalization:
    """The unit sphere of the scale matrices, which have to agree: all views see one scene."""
    all_scales = np.stack([_matrix(matrices, f"scale_mat_{i}", archive) for i in range(count)])
    matrix = all_scales[0]
    scale = matrix[0, 0]
    if not scale > 0 or not np.allclose(matrix[:3, :3], scale * np.eye(3), rtol=0, atol=1e-5 * abs(scale)):
        raise UserError(f"{archive}: scale_mat_0 is not a scale and a shift", "remove its rotation")
    if not np.allclose(all_scales, matrix, rtol=1e-4, atol=1e-4 * scale):
        raise UserError(f"{archive}: the scale matrices differ", "give all views the same")
    x, y, z = map(float, matrix[:3, 3])
    return Normalization(float(scale), (x, y, z))


def _files(root: Path, folder: Path) -> tuple[Path, ...]:
    """The images of a folder, in the order of their names, which must agree with that of their numbers."""
    candidates = (
        file
        for file in folder.iterdir()
        if file.suffix.lower() in IMAGE_SUFFIXES and not file.name.startswith(".")
    )
    files = sorted(candidates)
    numbers = [int(file.stem) for file in files if file.stem.isdecimal()]
    if len(numbers) == len(files) and numbers != sorted(numbers):
        after = next(i for i in range(1, len(numbers)) if numbers[i] < numbers[i - 1])
        raise UserError(
            f"{folder}: by name {files[after - 1].name} comes before {files[after].name}, by number after "
            "it, so it is not certain which camera belongs to which image",
            "pad the numbers with zeros: 007, 010",
        )
    return tuple(inside(root, file) for file in files)
