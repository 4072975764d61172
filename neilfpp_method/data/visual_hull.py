"""The visual hull of silhouettes: all places that no silhouette excludes, and its signed distance.

Every view with a mask says of each place that it sees whether the object can be there. What is left is the
smallest body that the masks alone can tell (Laurentini 1994): it holds the object, and has its outline from
every camera, but no hollow that is not seen from the side.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32
from scipy import ndimage
from torch import Tensor

from neilfpp_method.data.silhouettes import Outline, sightings

__all__ = ["HULL_RADIUS", "RESOLUTION", "DistanceCube", "find_hull", "signed_distance", "visual_hull"]

HULL_RADIUS = 1.3
"""Half an edge of the carved cube, scene units: the unit sphere, which holds the object, and a margin."""
RESOLUTION = 96
"""Cells along an edge, 0.027 scene units each: a start that training refines."""
MAX_EXCLUDING_SHARE = 0.05
"""Share of the views of a place that may exclude it, rounded down: a few masks are wrong."""
MIN_SEEN_SHARE = 0.25
"""Share of all views, and at least two views, that must see a place in the hull."""
MIN_CELLS = 64
"""Cells of the smallest hull that a field is started from."""
SMOOTHING = 1.5
"""Standard deviation, cells, of the blur that removes the steps of the cells. A ball of radius 0.6 then has
normals that are 2° off instead of 8°, and a radius that is 0.004 too small.
"""


@dataclass(frozen=True)
class DistanceCube:
    """Signed distance, scene units, negative inside, at the cell centres of the cube [−radius, radius]³.

    `distance[i, j, k]` belongs to x = −radius + (i + ½) · 2 radius / R, and y and z by j and k alike.
    """

    distance: Float32[Tensor, "R R R"]
    radius: float

    def at(self, x: Float[Tensor, "P 3"]) -> Float[Tensor, " P"]:
        """The distance at points of the scene frame, trilinear between centres.

        Beyond the outermost centres it is that of the nearest place within, and the way there: what a field
        takes from it far away is a slope of 1 that leads back.
        """
        grid = self.distance.to(x)
        edge = self.radius * (1.0 - 1.0 / len(grid))
        within = x.clamp(-edge, edge)
        # grid_sample has x along the last axis, and −1 and 1 on the outer faces of the outermost cells.
        place = (within / self.radius).flip(-1).view(1, -1, 1, 1, 3)
        found = torch.nn.functional.grid_sample(grid[None, None], place, mode="bilinear", align_corners=False)
        return found.view(-1) + (x - within).square().sum(-1).sqrt()


def find_hull(
    outlines: Sequence[Outline], radius: float = HULL_RADIUS, resolution: int = RESOLUTION
) -> DistanceCube | str:
    """The signed distance of the visual hull, or in a few words why these silhouettes do not make one.

    Args:
        outlines: silhouettes with their cameras in the scene frame.
        radius: half an edge of the cube that is carved, scene units.
        resolution: cells along an edge.

    Example:
        >>> hull = find_hull(outlines)
        >>> hull if isinstance(hull, str) else hull.at(torch.zeros(1, 3))  # negative: the origin is inside
    """
    hull = visual_hull(outlines, radius, resolution)
    if hull.sum() < MIN_CELLS:
        return "the masks have next to no place in common"
    # A body that leaves the cube has no surface there: masks show a ground, or the box is too small.
    faces = np.ones_like(hull)
    faces[1:-1, 1:-1, 1:-1] = False
    if hull[faces].any():
        return "what the masks show reaches beyond the scene box"
    return DistanceCube(torch.from_numpy(signed_distance(hull, 2 * radius / resolution)), radius)


def visual_hull(outlines: Sequence[Outline], radius: float, resolution: int) -> Bool[np.ndarray, "R R R"]:
    """Which cells of the cube [−radius, radius]³ have centres in nearly all silhouettes of views that see it.

    A view sees what is in its image, and what is beside its image where its silhouette does not touch the
    border (`Outline.complete`): a close-up says nothing of what lies outside it. A place that too few views
    see is not in the hull.

    Args:
        outlines: silhouettes with their cameras, in the frame of the cube.
        radius: half an edge of the cube.
        resolution: R.
    """
    centre = (np.arange(resolution) + 0.5) * (2 * radius / resolution) - radius
    points = np.stack(np.meshgrid(centre, centre, centre, indexing="ij"), axis=-1).reshape(-1, 3)
    candidates = np.arange(len(points))
    seen_by, excluded_by = np.zeros(len(points), np.int32), np.zeros(len(points), np.int32)
    # Small silhouettes first: they leave the least for the others to be asked about.
    for outline in sorted(outlines, key=lambda outline: float(outline.inside.mean())):
        found = sightings([outline], points[candidates])
        seen_by[candidates] += found.seen
        excluded_by[candidates] += found.seen - found.inside
        candidates = candidates[excluded_by[candidates] <= MAX_EXCLUDING_SHARE * len(outlines)]
    hull = np.zeros(len(points), bool)
    enough_views = seen_by[candidates] >= max(2, MIN_SEEN_SHARE * len(outlines))
    hull[candidates] = enough_views & (excluded_by[candidates] <= MAX_EXCLUDING_SHARE * seen_by[candidates])
    return hull.reshape(resolution, resolution, resolution)


def signed_distance(inside: Bool[np.ndarray, "R R R"], cell: float) -> Float32[np.ndarray, "R R R"]:
    """Smoothed Euclidean distance of cell centres from the surface of the body, negative inside.

    The surface lies half a cell from the centres next to it. `cell` is the width of a cell; without a cell
    inside, or outside, there is no surface and no distance.
    """
    within, without = ndimage.distance_transform_edt(inside), ndimage.distance_transform_edt(~inside)
    exact = np.where(inside, 0.5 - within, without - 0.5) * cell
    return ndimage.gaussian_filter(exact, SMOOTHING, mode="nearest").astype(np.float32)
