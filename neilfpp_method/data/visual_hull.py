"""Compute the visual hull of silhouettes, and its signed distance.

The visual hull consists of all points that no silhouette excludes (Laurentini 1994). It contains the object
and has the same outline in every view, but it fills concavities that no outline shows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64
from scipy import ndimage
from torch import Tensor

from neilfpp_method.data.silhouettes import Outline, sightings

__all__ = [
    "HULL_RADIUS",
    "MIN_CELLS",
    "MIN_SEEN_SHARE",
    "RESOLUTION",
    "DistanceCube",
    "cell_centers",
    "find_hull",
    "signed_distance",
    "visual_hull",
]

HULL_RADIUS = 1.3
"""Half an edge of the carved cube, scene units: the unit sphere, which contains the object, and a margin."""
RESOLUTION = 96
"""Number of cells along an edge of the cube. A cell is 0.027 scene units wide; training refines the result.
"""
MAX_EXCLUDING_SHARE = 0.05
"""Largest share of the views seeing a point that may exclude it, because a few masks may be wrong."""
MIN_SEEN_SHARE = 0.25
"""Smallest share of all views that must see a point of the hull; in addition, at least two views must."""
MIN_CELLS = 64
"""Smallest number of cells of a hull from which the distance field is initialised."""
SMOOTHING = 1.5
"""Standard deviation, in cells, of the Gaussian blur that removes the staircase of the cells. With it, the
normals of a ball of radius 0.6 are wrong by 2° instead of 8°, and its radius is 0.004 too small.
"""


@dataclass(frozen=True)
class DistanceCube:
    """Signed distance in scene units, negative inside, at the cell centres of the cube [−radius, radius]³.

    `distance[i, j, k]` is the distance at x = −radius + (i + ½) · 2 radius / R, with y and z from j and k in
    the same way.
    """

    distance: Float32[Tensor, "R R R"]
    radius: float

    def at(self, x: Float[Tensor, "P 3"]) -> Float[Tensor, " P"]:
        """Return the distance at points of the scene frame, interpolated trilinearly between cell centres.

        Outside of the outermost centres, the distance to the nearest point inside is added to the value
        there, so a field that is fitted far away has a gradient of length 1 that points outwards.
        """
        grid = self.distance.to(x)
        edge = self.radius * (1.0 - 1.0 / len(grid))
        within = x.clamp(-edge, edge)
        # In `grid_sample`, x is the last axis, and −1 and 1 are the outer faces of the outermost cells.
        place = (within / self.radius).flip(-1).view(1, -1, 1, 1, 3)
        value = torch.nn.functional.grid_sample(grid[None, None], place, mode="bilinear", align_corners=False)
        return value.view(-1) + (x - within).square().sum(-1).sqrt()


def find_hull(
    outlines: Sequence[Outline], radius: float = HULL_RADIUS, resolution: int = RESOLUTION
) -> DistanceCube | str:
    """Compute the signed distance of the visual hull.

    Args:
        outlines: silhouettes with their cameras in the scene frame.
        radius: half an edge of the cube that is carved, scene units.
        resolution: number of cells along an edge.

    Returns:
        The distance; or, if these silhouettes have no usable hull, the reason in a few words.

    Example:
        >>> hull = find_hull(outlines)
        >>> hull if isinstance(hull, str) else hull.at(torch.zeros(1, 3))  # negative: the origin is inside
    """
    hull = visual_hull(outlines, radius, resolution)
    if hull.sum() < MIN_CELLS:
        return "the masks have almost no region in common"
    # A hull that reaches the faces of the cube is cut off there: the masks show a ground, or the scene box is
    # too small.
    faces = np.ones_like(hull)
    faces[1:-1, 1:-1, 1:-1] = False
    if hull[faces].any():
        return "the masks show something that extends beyond the scene box"
    return DistanceCube(torch.from_numpy(signed_distance(hull, 2 * radius / resolution)), radius)


def visual_hull(outlines: Sequence[Outline], radius: float, resolution: int) -> Bool[np.ndarray, "R R R"]:
    """Return which cells of the cube [−radius, radius]³ are in the hull.

    The centre of such a cell lies in nearly all silhouettes of the views that see it, and enough views see
    it. A view sees the points in its image. If its silhouette does not touch the border (`Outline.complete`),
    it also sees the points beside its image, all of which are outside of the silhouette; a close-up has no
    information on these points.

    Args:
        outlines: silhouettes with their cameras, in the frame of the cube.
        radius: half an edge of the cube.
        resolution: number of cells along an edge, R.
    """
    points = cell_centers(radius, resolution)
    candidates = np.arange(len(points))
    seen_by, excluded_by = np.zeros(len(points), np.int32), np.zeros(len(points), np.int32)
    # Small silhouettes exclude the most points, so fewer points remain for the following views.
    for outline in sorted(outlines, key=lambda outline: float(outline.inside.mean())):
        counts = sightings([outline], points[candidates])
        seen_by[candidates] += counts.visible_in
        excluded_by[candidates] += counts.visible_in - counts.inside
        candidates = candidates[excluded_by[candidates] <= MAX_EXCLUDING_SHARE * len(outlines)]
    hull = np.zeros(len(points), bool)
    enough_views = seen_by[candidates] >= max(2, MIN_SEEN_SHARE * len(outlines))
    hull[candidates] = enough_views & (excluded_by[candidates] <= MAX_EXCLUDING_SHARE * seen_by[candidates])
    return hull.reshape(resolution, resolution, resolution)


def cell_centers(radius: float, resolution: int) -> Float64[np.ndarray, "P 3"]:
    """Centres of the R³ cells of the cube [−radius, radius]³, z fastest."""
    center = (np.arange(resolution) + 0.5) * (2 * radius / resolution) - radius
    return np.stack(np.meshgrid(center, center, center, indexing="ij"), axis=-1).reshape(-1, 3)


def signed_distance(inside: Bool[np.ndarray, "R R R"], cell: float) -> Float32[np.ndarray, "R R R"]:
    """Return the smoothed Euclidean distance of cell centres from the surface, negative inside.

    The surface lies half a cell from the centres next to it.

    Args:
        inside: which cells are inside; at least one cell must be inside and one outside.
        cell: width of a cell, in the unit of the result.
    """
    within, without = ndimage.distance_transform_edt(inside), ndimage.distance_transform_edt(~inside)
    exact = np.where(inside, 0.5 - within, without - 0.5) * cell
    return ndimage.gaussian_filter(exact, SMOOTHING, mode="nearest").astype(np.float32)
