"""Find the surface point of each texel, and fill the texels that show no surface."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from scipy.ndimage import distance_transform_edt

from neilfpp_method.export.asset.atlas import Unwrapped
from neilfpp_method.hosts.mesh_tracing import first_hits_of, intersect_planes

__all__ = ["Texels", "covered_texels", "dilate"]

TEXELS_AT_ONCE = 2**19
"""Number of texels per batch, which bounds the memory."""


@dataclass(frozen=True)
class Texels:
    """Texels whose centres lie in a triangle.

    Attributes:
        number: row-major index of the texel, from the top.
        face: index of the triangle.
        weights: barycentric coordinates of the texel's centre.
        done: share of the texture up to the end of this batch, in (0, 1].
    """

    number: Int[np.ndarray, " T"]
    face: Int[np.ndarray, " T"]
    weights: Float[np.ndarray, "T 3"]
    done: float

    def interpolate(
        self, values: Float[np.ndarray, "V C"], faces: Int[np.ndarray, "F 3"]
    ) -> Float[np.ndarray, "T C"]:
        """Interpolate values at vertices to the texels."""
        return (values[faces[self.face]] * self.weights[..., None]).sum(axis=1)


def covered_texels(mesh: Unwrapped, size: int) -> Iterator[Texels]:
    """Yield batches of the texels of a size × size texture whose centres lie in a triangle.

    The triangles in texture space form a flat surface at z = 0, and one ray per texel is traced onto it.
    """
    flat = torch.from_numpy(np.pad(mesh.uv, ((0, 0), (0, 1)))).float()[torch.from_numpy(mesh.faces)]
    tracer = first_hits_of(flat)
    down = torch.tensor([0.0, 0.0, -1.0])
    for number in torch.arange(size * size).split(TEXELS_AT_ONCE):
        u, v = (number % size + 0.5) / size, 1 - (number // size + 0.5) / size
        origins = torch.stack([u, v, torch.ones_like(u)], dim=-1)
        face = tracer(origins, down.expand_as(origins))
        rows = torch.nonzero(face >= 0)[:, 0]
        face, origins = face[rows], origins[rows]
        weights = intersect_planes(origins, down.expand_as(origins), flat[face]).weights.clamp(0, 1).double()
        weights = weights / weights.sum(-1, keepdim=True)
        done = (int(number[-1]) + 1) / size**2
        yield Texels(number[rows].numpy(), face.numpy(), weights.numpy(), done)


def dilate(
    texture: UInt8[np.ndarray, "S S C"], covered: Bool[np.ndarray, "S S"]
) -> UInt8[np.ndarray, "S S C"]:
    """Fill every uncovered texel with the value of the nearest covered texel.

    A bilinear or mip-mapped look-up then never reads a value that does not belong to the surface.
    """
    rows, columns = distance_transform_edt(~covered, return_distances=False, return_indices=True)
    return texture[rows, columns]
