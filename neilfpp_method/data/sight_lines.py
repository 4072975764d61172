"""Known empty space: the lines of sight from cameras to the points of a cloud that they see.

Nothing stands between a camera and a surface point in its image. Without masks this is the only direct
knowledge of empty space, and training needs it: with few photographs, density close to the cameras can
explain each photograph by itself (Deng et al. 2022, "Depth-supervised NeRF").
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from neilfpp_method.data.views import Camera, project
from neilfpp_method.structures import OrientedPoints, Segments

__all__ = ["find_sight_lines", "visible_points"]

MAX_POINTS = 40_000
"""Points of the cloud that are used. More points of the same surface tell nothing new."""
LINES_PER_VIEW = 4096
"""Lines of sight that are kept per camera, at 24 bytes each."""
MIN_COSINE = 0.3
"""Smallest cosine between a normal and the direction to the camera: flatter views of a point are unsure."""
CELL = 2.0
"""Size of a cell of the depth buffer, in distances between neighbouring points: a surface has no holes."""
TOLERANCE = 6.0
"""How far a visible point may lie behind the nearest point of its cell, in the same unit: surfaces slant."""
MARGIN = 0.05
"""Length before a point that is not counted as empty, scene units: points are not exactly on the surface."""


def find_sight_lines(cameras: Sequence[Camera], points: OrientedPoints) -> Segments:
    """The lines of sight from cameras to the cloud points that they see, up to `MARGIN` before the points.

    Args:
        cameras: of the training views, scene frame.
        points: oriented cloud, scene frame; it may reach beyond the scene sphere.

    Returns:
        Segments from cameras, scene frame; none of them if no camera sees a point.

    Example:
        >>> find_sight_lines(cameras, cloud).length.median()                                 # doctest: +SKIP
    """
    shuffle = np.random.default_rng(0)
    points = points[torch.from_numpy(shuffle.permutation(len(points.position))[:MAX_POINTS])]
    if len(points.position) < 2:
        return Segments(points.position[:0], points.position[:0])
    positions = points.position.numpy()
    spacing = float(np.median(cKDTree(positions).query(positions, k=2)[0][:, 1]))
    starts, ends = [], []
    for camera in cameras:
        visible = torch.nonzero(visible_points(camera, points, spacing))[:, 0][:LINES_PER_VIEW]
        position = points.position[visible]
        eye = torch.as_tensor(camera.c2w[:, 3], dtype=position.dtype).expand_as(position)
        distance = (position - eye).norm(dim=-1, keepdim=True)
        starts.append(eye)
        ends.append(torch.lerp(eye, position, (1 - MARGIN / distance).clamp_min(0)))
    return Segments(torch.cat(starts), torch.cat(ends))


def visible_points(camera: Camera, points: OrientedPoints, spacing: float) -> Bool[Tensor, " P"]:
    """Which points a camera sees: in its image, turned towards it, and not behind other points.

    Occlusion is tested with a depth buffer of the points themselves, with cells of `CELL` spacings at the
    median depth. A point is rejected if a point in its cell, or in a neighbouring cell, is nearer by more
    than `TOLERANCE` spacings.

    Args:
        camera: pose in the scene frame.
        points: oriented cloud, scene frame.
        spacing: distance between neighbouring points, scene units.
    """
    seen = project(camera, points.position)
    size = torch.tensor([camera.width, camera.height])
    within = (seen.depth > 0) & (seen.pixel >= 0).all(-1) & (seen.pixel < size).all(-1)
    if not within.any():
        return within
    pixels = max(CELL * spacing * camera.fx / float(seen.depth[within].median()), 1.0)
    nearest = _depth_buffer(seen.pixel[within] / pixels, seen.depth[within], (size / pixels).ceil().long())
    to_camera = torch.as_tensor(camera.c2w[:, 3], dtype=points.position.dtype) - points.position
    facing = torch.nn.functional.cosine_similarity(to_camera, points.normal, dim=-1) > MIN_COSINE
    visible = within.clone()
    visible[within] = seen.depth[within] <= nearest + TOLERANCE * spacing
    return visible & facing


def _depth_buffer(
    cell: Float[Tensor, "N 2"], depth: Float[Tensor, " N"], size: Int[Tensor, " 2"]
) -> Float[Tensor, " N"]:
    """For each of N points the smallest depth in its cell and the eight cells around it."""
    columns, rows = size.tolist()
    index = cell[:, 1].long() * columns + cell[:, 0].long()
    buffer = torch.full((rows * columns,), torch.inf, dtype=depth.dtype)
    buffer.scatter_reduce_(0, index, depth, "amin")
    grid = buffer.view(1, 1, rows, columns)
    return -torch.nn.functional.max_pool2d(-grid, 3, stride=1, padding=1).flatten()[index]
