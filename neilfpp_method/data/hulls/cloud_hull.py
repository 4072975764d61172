"""Compute the shape that a point cloud hides from the cameras, and its signed distance.

A point that a camera sees has empty space in front of it, and hides what is behind it. This is the fusion of
depth maps by a vote instead of a mean (Curless and Levoy 1996), because the depth maps of a point cloud have
gaps and false points. Space that no point hides, such as the sky above a roof, is empty. Like a visual hull,
the shape contains the object and fills what no camera sees.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float, Float64, Int64
from scipy import ndimage
from torch import Tensor

from neilfpp_method.data.cameras.camera import Camera, scaled_camera
from neilfpp_method.data.cameras.projection import pixel_index, project
from neilfpp_method.data.hulls.visual_hull import (
    MIN_CELLS,
    MIN_SEEN_SHARE,
    RESOLUTION,
    DistanceCube,
    cell_centers,
    signed_distance,
)
from neilfpp_method.structures import OrientedPoints

__all__ = ["find_cloud_hull"]

NOTHING_HIDDEN = "the point cloud hides almost nothing from the cameras"
"""Reason why there is no hull."""
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
PART = 2**16
"""Number of cells that are examined at once, so that their numbers stay in the processor's cache."""


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
    centers = torch.from_numpy(cell_centers(radius, resolution))
    points = points.to("cpu")
    if not len(points.position):
        return NOTHING_HIDDEN
    views = [(camera, _depth_map(camera, points)) for camera in map(_reduced, cameras)]
    # Cameras around an object show all points, those that look around in a room a few each.
    shown_in = sum(
        (pixel_index(project(camera, points.position), camera) >= 0).float() for camera, _ in views
    )
    min_views = max(2.0, float(MIN_SEEN_SHARE * shown_in.median()))
    # A corner of the cube is seen by few views, all of them from behind the object.
    in_ball = torch.nonzero(centers.norm(dim=-1) < radius + MARGIN * cell)[:, 0]
    solid = torch.zeros(len(centers), dtype=torch.bool)
    for part in in_ball.split(PART):
        solid[part[_hidden(views, centers[part], min_views, TOLERANCE * cell)]] = True
    if solid.sum() < MIN_CELLS:
        return NOTHING_HIDDEN
    cube = solid.numpy().reshape(resolution, resolution, resolution)
    return DistanceCube(torch.from_numpy(signed_distance(cube, cell)), radius)


def _hidden(
    views: Sequence[tuple[Camera, Float[Tensor, "H W"]]],
    centers: Float64[Tensor, "P 3"],
    min_views: float,
    tolerance: float,
) -> Int64[Tensor, " K"]:
    """Indices of the cells that are in enough images, and that points hide in nearly all of them."""
    index = torch.arange(len(centers))
    imaged, hidden, empty = torch.zeros(3, len(centers))
    for camera, depth_map in views:
        projected = project(camera, centers[index])
        pixel = pixel_index(projected, camera)
        in_image = pixel >= 0
        first = torch.where(in_image, depth_map.flatten()[pixel], torch.inf)
        in_front = projected.depth < first - tolerance
        known = first.isfinite()
        imaged, hidden, empty = imaged + in_image, hidden + (known & ~in_front), empty + (known & in_front)
        # Most cells are contradicted by so many views that the other views need not be examined.
        possible = (imaged - hidden <= (1 - MIN_HIDDEN_SHARE) * len(views)) & (
            empty <= MAX_EMPTY_SHARE * len(views)
        )
        index, imaged, hidden, empty = (values[possible] for values in (index, imaged, hidden, empty))
    hides = (hidden >= MIN_HIDDEN_SHARE * imaged) & (empty <= MAX_EMPTY_SHARE * imaged)
    return index[hides & (imaged >= min_views)]


def _reduced(camera: Camera) -> Camera:
    """The camera with the size of a depth map."""
    factor = DEPTH_SIDE / max(camera.width, camera.height)
    width, height = (max(1, round(factor * side)) for side in (camera.width, camera.height))
    return scaled_camera(camera, width, height)


def _depth_map(camera: Camera, points: OrientedPoints) -> Float[Tensor, "H W"]:
    """Depth of the first point that faces the camera in or near each pixel; infinite where there is none."""
    to_camera = torch.from_numpy(camera.c2w[:, 3]).to(points.position) - points.position
    projected = project(camera, points.position[(to_camera * points.normal).sum(-1) > 0])
    index = pixel_index(projected, camera)
    first = projected.depth.new_full((camera.height * camera.width,), torch.inf)
    first.scatter_reduce_(0, index[index >= 0], projected.depth[index >= 0], "amin")
    covered = ndimage.minimum_filter(first.view(camera.height, camera.width).numpy(), 2 * GAP + 1)
    return torch.from_numpy(covered)
