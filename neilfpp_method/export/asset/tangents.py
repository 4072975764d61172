"""Tangents of MikkTSpace (Mikkelsen 2008), which define the frame of normal maps in glTF and Blender."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from neilfpp_method.export.asset.atlas import Unwrapped

__all__ = ["vertex_tangents"]

TINY = 1e-20
"""Smallest squared length that counts as nonzero, and smallest divisor."""


def vertex_tangents(mesh: Unwrapped) -> Float[np.ndarray, "V 4"]:
    """Compute unit tangents along u at the vertices, and the sign of bitangent = sign · normal × tangent.

    The tangent of a vertex is the mean over its triangles of the direction of u, projected onto the tangent
    plane and weighted by the angle of the triangle at the vertex. Vertices of `mesh` are already split where
    normals or texture coordinates differ, as in MikkTSpace.
    """
    p, uv = mesh.vertices[mesh.faces], mesh.uv[mesh.faces]
    first, second = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
    (du1, dv1), (du2, dv2) = (uv[:, 1] - uv[:, 0]).T, (uv[:, 2] - uv[:, 0]).T
    sign = np.where(du1 * dv2 - dv1 * du2 < 0, -1.0, 1.0)
    along_u = sign[:, None] * (dv2[:, None] * first - dv1[:, None] * second)
    total, total_sign = np.zeros_like(mesh.vertices), np.zeros(len(mesh.vertices))
    for corner in range(3):
        vertex = mesh.faces[:, corner]
        normal = mesh.normals[vertex]
        to_next = _unit(_project(p[:, (corner + 1) % 3] - p[:, corner], normal))
        to_previous = _unit(_project(p[:, (corner + 2) % 3] - p[:, corner], normal))
        angle = np.arccos((to_next * to_previous).sum(-1).clip(-1, 1))
        np.add.at(total, vertex, angle[:, None] * _unit(_project(along_u, normal)))
        np.add.at(total_sign, vertex, angle * sign)
    # If the triangles of a vertex have no area in the texture, any direction in the tangent plane is valid.
    axis = np.eye(3)[np.abs(mesh.normals).argmin(axis=1)]
    total = np.where((total**2).sum(-1, keepdims=True) > TINY, total, _project(axis, mesh.normals))
    return np.concatenate([_unit(total), np.where(total_sign < 0, -1.0, 1.0)[:, None]], axis=1)


def _project(vector: Float[np.ndarray, "N 3"], normal: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    """Project vectors onto the planes perpendicular to unit normals."""
    return vector - (vector * normal).sum(-1, keepdims=True) * normal


def _unit(vector: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    return vector / np.sqrt((vector**2).sum(-1, keepdims=True)).clip(TINY)
