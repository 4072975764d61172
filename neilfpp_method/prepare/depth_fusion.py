"""Fusion of the depth maps of many views into one oriented point cloud.

COLMAP's `stereo_fusion` finds overlapping views by the tracks of a sparse model, which a capture that came
with its poses does not have. This module does the same consistency check and averaging without tracks, for
depth maps of any source.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from neilfpp_method.data.cameras.camera import Camera
from neilfpp_method.data.point_cloud import WorldPoints
from neilfpp_method.prepare.depth_planes import OrientedDepth, fit_planes

__all__ = ["DepthMap", "fuse_depth_maps"]

MAX_DISPARITY = 1.5
"""Largest difference of two inverse depths that agree, in steps of one pixel of disparity: the rounding of a
position to a pixel of the other view and the error of the two depth maps, about half a pixel each."""

MIN_COSINE = 0.7
"""Smallest cosine between two normals that agree: an angle of 45°."""

MIN_VIEWS = 2
"""Number of other views that must confirm a depth. A wrong depth rarely agrees with two others by chance."""


@dataclass(frozen=True)
class DepthMap:
    """The depth map of a view.

    Attributes:
        camera: the pinhole camera of the view.
        depth: depth along the optical axis, world units, 0 if unknown.
        step: the difference of inverse depth that the map can resolve.
        neighbors: indices of the views that may confirm its depths.
    """

    camera: Camera
    depth: Float32[np.ndarray, "H W"]
    step: float
    neighbors: Sequence[int]


def fuse_depth_maps(views: Sequence[DepthMap], advance: Callable[[], None]) -> WorldPoints:
    """Fuse depth maps into the oriented points that at least `MIN_VIEWS` other views confirm.

    A point of a view is projected into each neighbour. The neighbour confirms it if the inverse depth of its
    depth map at that pixel differs by at most `MAX_DISPARITY` steps and the normals by at most 45°. The
    position and normal of the fused point are the means over the view and the neighbours that confirm it, and
    the pixels that were averaged make no further points.

    Args:
        views: the depth map of each view.
        advance: called after each view, for a progress bar.

    Returns:
        Points and unit normals in the world frame; none if the depth maps agree nowhere.
    """
    confirmed = [
        _count_confirmations(view, [views[j] for j in view.neighbors]) >= MIN_VIEWS for view in views
    ]
    filtered = [
        np.where(mask, view.depth, np.float32(0)) for mask, view in zip(confirmed, views, strict=True)
    ]
    maps = [fit_planes(view.camera, depth, view.step) for view, depth in zip(views, filtered, strict=True)]
    used = [depth_map.depth <= 0 for depth_map in maps]
    positions, normals = [], []
    for i, view in enumerate(views):
        rows, columns = np.nonzero(~used[i])
        position = _unproject(view.camera, rows, columns, maps[i].depth[rows, columns])
        normal = maps[i].normal[rows, columns].astype(np.float64)
        position_sum, normal_sum, count = position.copy(), normal.copy(), np.ones(len(rows))
        for j in view.neighbors:
            other = _lookup(views[j].camera, maps[j], position, view.step)
            agrees = other.agrees & ((other.normal * normal).sum(axis=1) >= MIN_COSINE)
            position_sum[agrees] += other.position[agrees]
            normal_sum[agrees] += other.normal[agrees]
            count += agrees
            used[j][other.row[agrees], other.column[agrees]] = True
        kept = count > MIN_VIEWS
        positions.append(position_sum[kept] / count[kept, None])
        normals.append(normal_sum[kept] / np.linalg.norm(normal_sum[kept], axis=1, keepdims=True))
        advance()
    return WorldPoints(np.concatenate(positions), np.concatenate(normals))


@dataclass(frozen=True)
class _Surface:
    """The surface of a view's depth map at the pixels onto which points of the world project.

    Attributes:
        row: row of each pixel.
        column: column of each pixel.
        position: position by the depth map, world frame.
        normal: unit normal by the depth map, world frame.
        agrees: whether the depth map has the depth of the point.
    """

    row: Int64[np.ndarray, " N"]
    column: Int64[np.ndarray, " N"]
    position: Float64[np.ndarray, "N 3"]
    normal: Float64[np.ndarray, "N 3"]
    agrees: Bool[np.ndarray, " N"]


def _lookup(
    camera: Camera, depth_map: OrientedDepth, position: Float64[np.ndarray, "N 3"], step: float
) -> _Surface:
    at = _project(camera, position)
    depth = depth_map.depth[at.row, at.column].astype(np.float64)
    return _Surface(
        row=at.row,
        column=at.column,
        position=_unproject(camera, at.row, at.column, depth),
        normal=depth_map.normal[at.row, at.column].astype(np.float64),
        agrees=_agree(depth, at.depth, step),
    )


def _agree(a: Float64[np.ndarray, " N"], b: Float64[np.ndarray, " N"], step: float) -> Bool[np.ndarray, " N"]:
    """Whether both depths are known and their inverses differ by at most `MAX_DISPARITY` steps."""
    known = (a > 0) & (b > 0)
    difference = np.abs(1.0 / np.where(known, a, 1.0) - 1.0 / np.where(known, b, 1.0))
    return known & (difference <= MAX_DISPARITY * step)


def _count_confirmations(view: DepthMap, others: Sequence[DepthMap]) -> Float32[np.ndarray, "H W"]:
    """For each pixel of a view, the number of other views whose depth maps agree with its depth."""
    rows, columns = np.nonzero(view.depth > 0)
    position = _unproject(view.camera, rows, columns, view.depth[rows, columns])
    count = np.zeros(view.depth.shape, np.float32)
    for other in others:
        at = _project(other.camera, position)
        depth = other.depth[at.row, at.column].astype(np.float64)
        count[rows, columns] += _agree(depth, at.depth, view.step)
    return count


@dataclass(frozen=True)
class _Projected:
    """Points in a view: row and column of their pixels, and their depths along the optical axis.

    Outside of the image they are 0, 0 and −1.
    """

    row: Int64[np.ndarray, " N"]
    column: Int64[np.ndarray, " N"]
    depth: Float64[np.ndarray, " N"]


def _project(camera: Camera, position: Float64[np.ndarray, "N 3"]) -> _Projected:
    """Project points of the world frame into a view."""
    local = position @ camera.w2c[:3, :3].T + camera.w2c[:3, 3]
    depth = local[:, 2]
    plane = local[:, :2] / np.where(depth > 0, depth, 1.0)[:, None]
    pixel = plane * camera.intrinsics[:2] + camera.intrinsics[2:]
    inside = (depth > 0) & (pixel >= 0).all(axis=1) & (pixel < [camera.width, camera.height]).all(axis=1)
    column, row = np.where(inside[:, None], pixel, 0.0).astype(np.int64).T
    return _Projected(row, column, np.where(inside, depth, -1.0))


def _unproject(
    camera: Camera, rows: np.ndarray, columns: np.ndarray, depth: np.ndarray
) -> Float64[np.ndarray, "N 3"]:
    """World positions of pixel centres at the given depths."""
    plane = (np.stack([columns, rows], axis=1) + 0.5 - camera.intrinsics[2:]) / camera.intrinsics[:2]
    local = np.pad(plane, ((0, 0), (0, 1)), constant_values=1.0) * np.asarray(depth, np.float64)[:, None]
    return local @ camera.c2w[:, :3].T + camera.c2w[:, 3]
