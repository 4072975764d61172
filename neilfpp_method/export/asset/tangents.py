"""Tangents as MikkTSpace makes them (Mikkelsen 2008): the frame of normal maps in glTF and Blender."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from neilfpp_method.export.asset.atlas import Unwrapped

__all__ = ["vertex_tangents"]

TINY = 1e-20


def vertex_tangents(mesh: Unwrapped) -> Float[np.ndarray, "V 4"]:
    """Unit tangents along u at the vertices, and the sign in bitangent = sign · normal × tangent, along v.

    A vertex has the mean over its triangles of the direction of u in its tangent plane, weighted by their
    angles there. Here vertices are parted where normal or texture place differ, as MikkTSpace parts them.
    """
    p, uv = mesh.vertices[mesh.faces], mesh.uv[mesh.faces]
    first, second = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
    (du1, dv1), (du2, dv2) = (uv[:, 1] - uv[:, 0]).T, (uv[:, 2] - uv[:, 0]).T
    sign = np.where(du1 * dv2 - dv1 * du2 < 0, -1.0, 1.0)
    along_u = sign[:, None] * (dv2[:, None] * first - dv1[:, None] * second)
    total, turned = np.zeros_like(mesh.vertices), np.zeros(len(mesh.vertices))
    for corner in range(3):
        vertex = mesh.faces[:, corner]
        normal = mesh.normals[vertex]
        ahead = _unit(_across(p[:, (corner + 1) % 3] - p[:, corner], normal))
        behind = _unit(_across(p[:, (corner + 2) % 3] - p[:, corner], normal))
        angle = np.arccos((ahead * behind).sum(-1).clip(-1, 1))
        np.add.at(total, vertex, angle[:, None] * _unit(_across(along_u, normal)))
        np.add.at(turned, vertex, angle * sign)
    # Where a triangle has no extent in the texture, any direction across the normal will do.
    axis = np.eye(3)[np.abs(mesh.normals).argmin(axis=1)]
    total = np.where((total**2).sum(-1, keepdims=True) > TINY, total, _across(axis, mesh.normals))
    return np.concatenate([_unit(total), np.where(turned < 0, -1.0, 1.0)[:, None]], axis=1)


def _across(vector: Float[np.ndarray, "N 3"], normal: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    """The part of a vector that is perpendicular to a unit normal."""
    return vector - (vector * normal).sum(-1, keepdims=True) * normal


def _unit(vector: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    return vector / np.sqrt((vector**2).sum(-1, keepdims=True)).clip(TINY)
