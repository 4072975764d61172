"""A corner of a room with noise textures on its floor and two walls, photographed along an arc; everything is
known and easy to match.

Rays are intersected with the planes in NumPy, without the package's cameras. World +z is up; all visible
coordinates lie between 0 and 1.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from neilfpp_method.data.files.images import write_exr, write_png

TARGET = np.array([0.3, 0.3, 0.25])
DISTANCE = 1.5
FOCAL = 1.25
"""In units of the image's width."""


def noise(seed: int, size: int = 512) -> np.ndarray:
    """A texture with detail at all scales, linear values from 0.05 to 1."""
    rng = np.random.default_rng(seed)
    layers = [
        cv2.resize(rng.random((size // s, size // s, 3)), (size, size), interpolation=cv2.INTER_CUBIC)
        for s in (4, 8, 16, 64)
    ]
    texture = sum(layers) / len(layers)
    return np.clip((texture - 0.3) / 0.4, 0.05, 1.0).astype(np.float32)


TEXTURES = [noise(seed) for seed in range(3)]


def pose(i: int, views: int, arc: float = 70.0) -> np.ndarray:
    """World to camera: on an arc around the corner, alternately at two heights."""
    azimuth, elevation = np.radians(45 + arc * (i / max(views - 1, 1) - 0.5)), np.radians(30 + 12 * (i % 2))
    outward = np.array(
        [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)]
    )
    right = np.cross(-outward, [0, 0, 1])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(-outward, right), -outward])
    w2c = np.eye(4)
    w2c[:3, :3], w2c[:3, 3] = rotation, -rotation @ (TARGET + DISTANCE * outward)
    return w2c


def photograph(w2c: np.ndarray, size: tuple[int, int], focal: float = FOCAL) -> np.ndarray:
    """Linear radiance (H, W, 3); black outside of the corner."""
    width, height = size
    rows, columns = np.mgrid[:height, :width] + 0.5
    rays = np.stack(
        [(columns - width / 2) / (focal * width), (rows - height / 2) / (focal * width), np.ones_like(rows)],
        axis=-1,
    )
    directions, eye = rays @ w2c[:3, :3], -w2c[:3, :3].T @ w2c[:3, 3]
    image, nearest = np.zeros((height, width, 3), np.float32), np.full((height, width), np.inf)
    for axis in range(3):
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = -eye[axis] / directions[..., axis]
            hit = eye + distance[..., None] * directions
        on = np.delete(hit, axis, axis=-1)
        seen = (distance > 0) & (distance < nearest) & (on > 0).all(axis=-1) & (on < 1).all(axis=-1)
        where = (np.nan_to_num(on) * 511).astype(np.float32)
        color = cv2.remap(TEXTURES[axis], where[..., 0], where[..., 1], cv2.INTER_LINEAR)
        image[seen], nearest[seen] = color[seen], distance[seen]
    return image


def make_photos(
    folder: Path, views: int = 9, size: tuple[int, int] = (240, 180), hdr: bool = True, name: str = "{:03}"
) -> list[np.ndarray]:
    """Write the photographs as EXR or PNG, and return their poses."""
    poses = [pose(i, views) for i in range(views)]
    for i, w2c in enumerate(poses):
        pixels = photograph(w2c, size)
        if hdr:
            write_exr(
                folder / f"{name.format(i)}.exr", {"RGB": 4.0 * pixels}
            )  # an exposure outside of the display range
        else:
            write_png(folder / f"{name.format(i)}.png", np.rint(255 * pixels ** (1 / 2.2)).astype(np.uint8))
    return poses


def alignment(found: np.ndarray, true: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """The similarity (scale, rotation, shift) that maps points `found` to `true` with the least squared
    error, by Umeyama's closed form.
    """
    a, b = found - found.mean(0), true - true.mean(0)
    u, s, vt = np.linalg.svd(b.T @ a)
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = u @ flip @ vt
    scale = (s * np.diag(flip)).sum() / (a**2).sum()
    return scale, rotation, true.mean(0) - scale * rotation @ found.mean(0)


def angle(a: np.ndarray, b: np.ndarray) -> float:
    """Angle between two rotations, degrees."""
    return float(np.degrees(np.arccos(np.clip((np.trace(a @ b.T) - 1) / 2, -1, 1))))
