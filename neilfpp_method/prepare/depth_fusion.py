"""Depth maps of many views become one oriented cloud: what several views agree on, once.

COLMAP's `stereo_fusion` takes the overlap of the views from the tracks of a sparse model, and a capture that
came with its poses has none. What it does is short enough to be said here, and is the same for all sources of
depth.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64

from neilfpp_method.data.point_cloud import WorldPoints
from neilfpp_method.data.views import Camera
from neilfpp_method.prepare.depth_planes import OrientedDepth, fit_planes

__all__ = ["fuse"]

AGREEMENT = 1.5
MIN_COSINE = 0.7
MIN_WITNESSES = 2


def fuse(
    cameras: Sequence[Camera],
    depths: Sequence[Float32[np.ndarray, "H W"]],
    grains: Sequence[float],
    neighbours: Sequence[Sequence[int]],
    advance: Callable[[], None],
) -> WorldPoints:
    """The oriented points on which at least two other views agree.

    A view agrees with a point where the inverse depth that it has in the point's place differs by at most 1.5
    grains, and the normals by at most 45°. Point and normal are the means over the views that agree; these
    pixels make no point of their own.

    Args:
        cameras: pinholes.
        depths: depth maps along their axes, 0 where not known.
        grains: the difference of inverse depth that each view's depth map can tell.
        neighbours: for each view the others that are asked.
        advance: called once per view.
    """
    agreed = [
        _witnesses(cameras, depths, i, grains[i], others) >= MIN_WITNESSES
        for i, others in enumerate(neighbours)
    ]
    trusted = [np.where(sure, depth, np.float32(0)) for sure, depth in zip(agreed, depths, strict=True)]
    maps = [fit_planes(*view) for view in zip(cameras, trusted, grains, strict=True)]
    taken = [depth.depth <= 0 for depth in maps]
    positions, normals = [], []
    for i, camera in enumerate(cameras):
        rows, columns = np.nonzero(~taken[i])
        position = _unproject(camera, rows, columns, maps[i].depth[rows, columns])
        normal = maps[i].normal[rows, columns].astype(np.float64)
        total, direction, count = position.copy(), normal.copy(), np.ones(len(rows))
        for j in neighbours[i]:
            seen = _lookup(cameras[j], maps[j], position, grains[i])
            agrees = seen.agrees & ((seen.normal * normal).sum(axis=1) >= MIN_COSINE)
            total[agrees] += seen.position[agrees]
            direction[agrees] += seen.normal[agrees]
            count += agrees
            taken[j][seen.row[agrees], seen.column[agrees]] = True
        kept = count > MIN_WITNESSES
        positions.append(total[kept] / count[kept, None])
        normals.append(direction[kept] / np.linalg.norm(direction[kept], axis=1, keepdims=True))
        advance()
    return WorldPoints(np.concatenate(positions), np.concatenate(normals))


@dataclass(frozen=True)
class Seen:
    """What a view has in the place of points of the world: in which pixel, its own position and normal there,
    and whether the depths agree.
    """

    row: np.ndarray
    column: np.ndarray
    position: Float64[np.ndarray, "N 3"]
    normal: Float64[np.ndarray, "N 3"]
    agrees: Bool[np.ndarray, " N"]


def _lookup(camera: Camera, known: OrientedDepth, position: Float64[np.ndarray, "N 3"], grain: float) -> Seen:
    row, column, depth = _project(camera, position)
    there = known.depth[row, column].astype(np.float64)
    normal = known.normal[row, column].astype(np.float64)
    return Seen(row, column, _unproject(camera, row, column, there), normal, _agree(there, depth, grain))


def _agree(
    a: Float64[np.ndarray, " N"], b: Float64[np.ndarray, " N"], grain: float
) -> Bool[np.ndarray, " N"]:
    known = (a > 0) & (b > 0)
    return known & (
        np.abs(1.0 / np.where(known, a, 1.0) - 1.0 / np.where(known, b, 1.0)) <= AGREEMENT * grain
    )


def _witnesses(
    cameras: Sequence[Camera],
    depths: Sequence[Float32[np.ndarray, "H W"]],
    i: int,
    grain: float,
    others: Sequence[int],
) -> Float32[np.ndarray, "H W"]:
    """How many other views have the depth that each pixel of view i says."""
    rows, columns = np.nonzero(depths[i] > 0)
    position = _unproject(cameras[i], rows, columns, depths[i][rows, columns])
    count = np.zeros(depths[i].shape, np.float32)
    for j in others:
        row, column, depth = _project(cameras[j], position)
        count[rows, columns] += _agree(depths[j][row, column].astype(np.float64), depth, grain)
    return count


def _project(
    camera: Camera, position: Float64[np.ndarray, "N 3"]
) -> tuple[np.ndarray, np.ndarray, Float64[np.ndarray, " N"]]:
    """Row, column and depth of points; a depth of −1 where the view does not show them, with some pixel."""
    local = position @ camera.w2c[:3, :3].T + camera.w2c[:3, 3]
    depth = local[:, 2]
    pixel = (
        local[:, :2] / np.where(depth > 0, depth, 1.0)[:, None] * camera.intrinsics[:2]
        + camera.intrinsics[2:]
    )
    shown = (depth > 0) & (pixel >= 0).all(axis=1) & (pixel < [camera.width, camera.height]).all(axis=1)
    column, row = np.where(shown[:, None], pixel, 0.0).astype(np.int64).T
    return row, column, np.where(shown, depth, -1.0)


def _unproject(
    camera: Camera, rows: np.ndarray, columns: np.ndarray, depth: np.ndarray
) -> Float64[np.ndarray, "N 3"]:
    plane = (np.stack([columns, rows], axis=1) + 0.5 - camera.intrinsics[2:]) / camera.intrinsics[:2]
    local = np.pad(plane, ((0, 0), (0, 1)), constant_values=1.0) * np.asarray(depth, np.float64)[:, None]
    return local @ camera.c2w[:, :3].T + camera.c2w[:, 3]
