"""Compute the visual hull of silhouettes, and its signed distance.

The visual hull consists of all points that no silhouette excludes (Laurentini 1994). It contains the object
and has the same outline in every view, but it fills concavities that no outline shows.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64, Int64
from scipy import ndimage
from torch import Tensor

from neilfpp_method.data.hulls.silhouettes import Outline, sightings

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
RESOLUTION = 192
"""Number of cells along an edge of the cube. A cell is 0.014 scene units wide, as in the grids of `fast`;
parts that are thinner are lost.
"""
SUBDIVISION = 4
"""Number of cells along an edge of a block. Blocks are examined first, so that most cells need not be."""
MAX_EXCLUDING_SHARE = 0.05
"""Largest share of the views seeing a point that may exclude it, because a few masks may be wrong."""
MIN_SEEN_SHARE = 0.25
"""Smallest share of all views that must see a point of the hull; in addition, at least two views must."""
MIN_CELLS = 64
"""Smallest number of cells of a hull from which the distance field is initialised."""
MAX_CUT = 0.01
"""Largest number of hull cells on the faces of the cube, relative to the number of all hull cells to the
power of 2/3, which is about the cross-section of the hull. A hull with more is cut off by the cube: the masks
show a ground, or the scene box is too small. A few cells come from stray pixels of masks; they are removed.
"""
SMOOTHING = 1.5
"""Standard deviation, in cells, of the Gaussian blur that removes the staircase of the cells. With it, the
normals of a ball of radius 0.6 are wrong by 2° instead of 8°, and its radius is 0.004 too small.
"""
MAX_CHANGE = 1.0
"""Largest change of the distance by this blur, in cells. It changes more only at parts that are a few cells
thin, which it would remove; the distance is exact there.
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
    faces = np.ones_like(hull)
    faces[1:-1, 1:-1, 1:-1] = False
    if hull[faces].sum() > MAX_CUT * hull.sum() ** (2 / 3):
        return "the masks show something that extends beyond the scene box"
    hull[faces] = False
    distance = signed_distance(hull, 2 * radius / resolution, keeps_thin_parts=True)
    return DistanceCube(torch.from_numpy(distance), radius)


def visual_hull(outlines: Sequence[Outline], radius: float, resolution: int) -> Bool[np.ndarray, "R R R"]:
    """Return which cells of the cube [−radius, radius]³ are in the hull.

    The centre of such a cell lies in nearly all silhouettes of the views that see it, and enough views see
    it. A view sees the points in its image. If its silhouette does not touch the border (`Outline.complete`),
    it also sees the points beside its image, all of which are outside of the silhouette; a close-up has no
    information on these points.

    Args:
        outlines: silhouettes with their cameras, in the frame of the cube.
        radius: half an edge of the cube.
        resolution: number of cells along an edge, R, a multiple of `SUBDIVISION`.
    """
    # Small silhouettes exclude the most points, so fewer points remain for the following views.
    outlines = sorted(outlines, key=lambda outline: float(outline.inside.mean()))
    blocks = resolution // SUBDIVISION
    block_centers = cell_centers(radius, blocks)
    near = _not_excluded(outlines, block_centers, reach=math.sqrt(3) * radius / blocks)
    in_block = cell_centers(radius / blocks, SUBDIVISION)
    points = (block_centers[near.index][:, None] + in_block).reshape(-1, 3)
    held = _not_excluded(outlines, points)
    enough_views = held.seen_by >= max(2, MIN_SEEN_SHARE * len(outlines))
    is_hull = np.zeros(len(points), bool)
    is_hull[held.index] = enough_views & (held.excluded_by <= MAX_EXCLUDING_SHARE * held.seen_by)
    # The axes are those of the blocks, followed by those of the cells within a block.
    hull = np.zeros((blocks**3, SUBDIVISION**3), bool)
    hull[near.index] = is_hull.reshape(-1, SUBDIVISION**3)
    hull = hull.reshape(*[blocks] * 3, *[SUBDIVISION] * 3)
    return hull.transpose(0, 3, 1, 4, 2, 5).reshape(resolution, resolution, resolution)


@dataclass(frozen=True)
class _Candidates:
    """K of many points or balls: their indices, and how many views see and exclude each of them."""

    index: Int64[np.ndarray, " K"]
    seen_by: Int64[np.ndarray, " K"]
    excluded_by: Int64[np.ndarray, " K"]


def _not_excluded(
    outlines: Sequence[Outline], points: Float64[np.ndarray, "P 3"], reach: float = 0.0
) -> _Candidates:
    """The points, or with a `reach` the balls around them, that nearly no silhouette excludes."""
    index = np.arange(len(points))
    seen_by, excluded_by = np.zeros(len(points), np.int64), np.zeros(len(points), np.int64)
    for outline in outlines:
        counts = sightings([outline], points[index], reach)
        seen_by += counts.visible_in
        excluded_by += counts.visible_in - counts.inside
        kept = excluded_by <= MAX_EXCLUDING_SHARE * len(outlines)
        index, seen_by, excluded_by = index[kept], seen_by[kept], excluded_by[kept]
    return _Candidates(index, seen_by, excluded_by)


def cell_centers(radius: float, resolution: int) -> Float64[np.ndarray, "P 3"]:
    """Centres of the R³ cells of the cube [−radius, radius]³, z fastest."""
    center = (np.arange(resolution) + 0.5) * (2 * radius / resolution) - radius
    return np.stack(np.meshgrid(center, center, center, indexing="ij"), axis=-1).reshape(-1, 3)


def signed_distance(
    inside: Bool[np.ndarray, "R R R"], cell: float, keeps_thin_parts: bool = False
) -> Float32[np.ndarray, "R R R"]:
    """Return the smoothed Euclidean distance of cell centres from the surface, negative inside.

    The surface lies half a cell from the centres next to it.

    Args:
        inside: which cells are inside; at least one cell must be inside and one outside.
        cell: width of a cell, in the unit of the result.
        keeps_thin_parts: whether parts that are a few cells thin remain; the blur removes them otherwise.
    """
    exact = (_cells_to(inside) - 0.5).astype(np.float32)
    around = _surroundings(inside)
    exact[around] = np.where(inside[around], 0.5 - _cells_to(~inside[around]), exact[around])
    blurred = ndimage.gaussian_filter(exact, SMOOTHING, mode="nearest")
    if keeps_thin_parts:
        blurred = np.where(np.abs(blurred - exact) > MAX_CHANGE, exact, blurred)
    return cell * blurred


def _cells_to(target: Bool[np.ndarray, "A B C"]) -> Float64[np.ndarray, "A B C"]:
    """Euclidean distance of cells from the nearest cell of `target`.

    The distances of `distance_transform_edt` take as long again as the indices they are computed from.
    """
    nearest = ndimage.distance_transform_edt(~target, return_distances=False, return_indices=True)
    offsets = zip(nearest, np.ogrid[tuple(map(slice, target.shape))], strict=True)
    return np.sqrt(sum(np.square(there - here) for there, here in offsets))


def _surroundings(inside: Bool[np.ndarray, "R R R"]) -> tuple[slice, ...]:
    """The smallest box that contains the cells inside and, within the cube, all their neighbours."""
    rows = [np.flatnonzero(inside.any(axis=others)) for others in ((1, 2), (0, 2), (0, 1))]
    return tuple(slice(max(row[0] - 1, 0), row[-1] + 2) for row in rows)
