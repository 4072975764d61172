"""Unwrap a surface onto one square texture (xatlas)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xatlas
from jaxtyping import Float, Int

from neilfpp_method.data.files.ply import needs_double
from neilfpp_method.errors import UserError
from neilfpp_method.export.asset.surface import AssetSurface

__all__ = ["Unwrapped", "unwrap"]

GAP = 6
"""Requested distance between charts, texels."""
MIN_GAP = 2.0
"""Least distance between charts, texels, so that a bilinear look-up does not read from another chart."""


@dataclass(frozen=True)
class Unwrapped:
    """A mesh in which every vertex has one normal and one texture coordinate.

    Attributes:
        vertices: positions.
        normals: unit normals at the vertices.
        uv: texture coordinates in [0, 1], v upwards.
        faces: triangles.
        charts: number of charts.
        gap: distance between charts, texels.
    """

    vertices: Float[np.ndarray, "V 3"]
    normals: Float[np.ndarray, "V 3"]
    uv: Float[np.ndarray, "V 2"]
    faces: Int[np.ndarray, "F 3"]
    charts: int
    gap: float

    @property
    def origin(self) -> Float[np.ndarray, " 3"]:
        """The point from which GLB and USD count their positions, which are in single precision.

        It is the origin of the frame, unless rounding would move vertices noticeably, as in map coordinates;
        then it is the centre of the bounding box.
        """
        if not needs_double(self.vertices):
            return np.zeros(3)
        return (self.vertices.min(axis=0) + self.vertices.max(axis=0)) / 2


def unwrap(surface: AssetSurface, size: int) -> Unwrapped:
    """Unwrap the triangles without overlap onto a texture of size × size texels.

    Raises:
        UserError: the charts do not fit with two texels between them.
    """
    # A vertex on a crease has several normals and becomes one vertex for each of them.
    corners = np.concatenate([surface.faces[..., None], surface.normals], axis=-1).reshape(-1, 4)
    wedges, wedge = np.unique(corners, axis=0, return_inverse=True)
    vertices, normals = surface.vertices[wedges[:, 0].astype(np.int64)], wedges[:, 1:]
    packing, atlas = xatlas.PackOptions(), xatlas.Atlas()
    packing.resolution, packing.padding = size, GAP
    atlas.add_mesh(
        vertices.astype(np.float32), wedge.reshape(-1, 3).astype(np.uint32), normals.astype(np.float32)
    )
    atlas.generate(xatlas.ChartOptions(), packing)
    source, faces, uv = atlas.get_mesh(0)
    # xatlas does not always keep the requested resolution, so its result is scaled to the texture.
    extent = np.array([atlas.width, atlas.height])
    gap = GAP * size / extent.max()
    if atlas.atlas_count != 1 or gap < MIN_GAP:
        raise UserError(
            f"{atlas.chart_count} charts of {len(faces)} triangles do not fit on a texture of {size}×{size}",
            "raise --texture-size, or raise --error",
        )
    return Unwrapped(
        vertices[source],
        normals[source],
        uv * (extent / extent.max()),
        faces.astype(np.int64),
        atlas.chart_count,
        gap,
    )
