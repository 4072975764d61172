"""Compute the shape that a point cloud hides from the cameras, and its signed distance.

A point that a camera sees has empty space in front of it, and hides what is behind it. This is the fusion of
depth maps by a vote instead of a mean (Curless and Levoy 1996), because the depth maps of a point cloud have
gaps and false points. Space that no point hides, such as the sky above a roof, is empty. Like a visual hull,
the shape contains the object and fills what no camera sees.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64, Int64
from scipy import ndimage

from neilfpp_method.data.views import Camera, project
from neilfpp_method.data.visual_hull import (
    MIN_CELLS,
    MIN_SEEN_SHARE,
    RESOLUTION,
    DistanceCube,
    cell_centers,
    signed_distance,
)
from neilfpp_method.structures import OrientedPoints

__all__ = ["find_cloud_hull"]

DEPTH_SIDE = 96
"""Longer side of a depth map in pixels; a pixel then shows about as much as a cell of the cube is wide."""
GAP = 2
"""Distance in pixels over which a point also covers its neighbours. Without it, cameras look through the gaps
between the points of an object and find the table behind it: the objects of `tabletop_env` disappear.
"""
TOLERANCE = 1.5
"""Smallest distance in front of a point at which space is empty, in cells."""
MARGIN = 2
"""Cells by which the shape extends beyond the ball, so that the cut is outside."""
MIN_HIDDEN_SHARE = 0.5
"""Smallest share of the views with a cell in the image from which points must hide it."""
MAX_EMPTY_SHARE = 0.2
"""Largest share of these views that may see a cell as empty. False points and gaps cause some."""


def find_cloud_hull(
    points: OrientedPoints, cameras: Sequence[Camera], radius: float, resolution: int = RESOLUTION
) -> DistanceCube | str:
    """Compute the signed distance of the shape that points hide.

    Args:
        points: surface points with outward normals, scene frame.
        cameras: the cameras that saw them, scene frame.
        radius: radius of the ball in which the shape is needed, and half an edge of the cube of the result,
            scene units. Shapes that extend beyond the ball are cut off `MARGIN` cells outside of it.
        resolution: number of cells along an edge.

    Returns:
        The distance; or, if the points hide almost nothing, the reason in a few words.

    Example:
        >>> hull = find_cloud_hull(points, cameras, radius=1.75)
        >>> hull if isinstance(hull, str) else hull.at(points.position)  # about 0
    """
    cell = 2 * radius / resolution
    centers = cell_centers(radius, resolution)
    # A corner of the cube is seen by few views, all of them from behind the object.
    in_ball = np.linalg.norm(centers, axis=1) < radius + MARGIN * cell
    views, hidden, empty = (np.zeros(len(centers), np.int32) for _ in range(3))
    for camera in cameras:
        depth = _depth_map(camera, points)
        cells = _pixels(camera, centers, depth.shape)
        in_image = cells.index >= 0
        first = np.where(in_image, depth.ravel()[cells.index], np.inf)
        in_front = cells.depth < first - TOLERANCE * cell
        known = np.isfinite(first)
        views += in_image
        empty += known & in_front
        hidden += known & ~in_front
    enough_views = views >= max(2, MIN_SEEN_SHARE * len(cameras))
    hides = (hidden >= MIN_HIDDEN_SHARE * views) & (empty <= MAX_EMPTY_SHARE * views)
    solid = in_ball & enough_views & hides
    if solid.sum() < MIN_CELLS:
        return "the point cloud hides almost nothing from the cameras"
    cube = solid.reshape(resolution, resolution, resolution)
    return DistanceCube(torch.from_numpy(signed_distance(cube, cell)), radius)


def _depth_map(camera: Camera, points: OrientedPoints) -> Float64[np.ndarray, "H W"]:
    """Depth of the first point that faces the camera in or near each pixel; infinite where there is none."""
    factor = DEPTH_SIDE / max(camera.width, camera.height)
    shape = max(1, round(factor * camera.height)), max(1, round(factor * camera.width))
    position, normal = points.position.double().cpu().numpy(), points.normal.double().cpu().numpy()
    facing = ((camera.c2w[:, 3] - position) * normal).sum(axis=1) > 0
    seen = _pixels(camera, position[facing], shape)
    in_image = seen.index >= 0
    first = np.full(shape[0] * shape[1], np.inf)
    np.minimum.at(first, seen.index[in_image], seen.depth[in_image])
    return ndimage.minimum_filter(first.reshape(shape), 2 * GAP + 1)


@dataclass(frozen=True)
class _Pixels:
    """Where a camera sees P points.

    Attributes:
        index: number of the pixel, row by row; −1 if the point is not in the image.
        depth: distance along the optical axis.
    """

    index: Int64[np.ndarray, " P"]
    depth: Float64[np.ndarray, " P"]


def _pixels(camera: Camera, points: Float64[np.ndarray, "P 3"], shape: tuple[int, int]) -> _Pixels:
    """The pixels of points in an image of another size (rows, columns) with the same field of view."""
    height, width = shape
    projected = project(camera, torch.from_numpy(points))
    across, down = (projected.pixel.numpy() * [width / camera.width, height / camera.height]).T
    depth = projected.depth.numpy()
    with np.errstate(invalid="ignore"):
        visible = (depth > 0) & (across >= 0) & (across < width) & (down >= 0) & (down < height)
    column, row = (np.where(visible, place, 0).astype(np.int64) for place in (across, down))
    return _Pixels(np.where(visible, row * width + column, -1), depth)
