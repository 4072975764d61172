"""Which point of a surface each texel shows; and what texels hold that show none."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from scipy.ndimage import distance_transform_edt

from neilfpp_method.export.asset.atlas import Unwrapped
from neilfpp_method.hosts.mesh_tracing import build_tree, embree_tracer, meet, tree_tracer

__all__ = ["Texels", "covered_texels", "dilate"]

TEXELS_AT_ONCE = 2**19


@dataclass(frozen=True)
class Texels:
    """Texels by number, row by row from the top, the triangle at each middle, and its corner weights."""

    number: Int[np.ndarray, " T"]
    face: Int[np.ndarray, " T"]
    weights: Float[np.ndarray, "T 3"]

    def interpolate(
        self, values: Float[np.ndarray, "V C"], faces: Int[np.ndarray, "F 3"]
    ) -> Float[np.ndarray, "T C"]:
        """Values at vertices, at the texels."""
        return (values[faces[self.face]] * self.weights[..., None]).sum(axis=1)


def covered_texels(mesh: Unwrapped, size: int) -> Iterator[Texels]:
    """The texels of a size × size texture whose middle lies in a triangle, in parts of bounded size.

    The atlas is a flat surface at z = 0, looked at from above: a ray per texel.
    """
    flat = torch.from_numpy(np.pad(mesh.uv, ((0, 0), (0, 1)))).float()[torch.from_numpy(mesh.faces)]
    tracer = embree_tracer(flat) or tree_tracer(build_tree(flat))
    down = torch.tensor([0.0, 0.0, -1.0])
    for number in torch.arange(size * size).split(TEXELS_AT_ONCE):
        u, v = (number % size + 0.5) / size, 1 - (number // size + 0.5) / size
        origins = torch.stack([u, v, torch.ones_like(u)], dim=-1)
        face = tracer(origins, down.expand_as(origins))
        rows = torch.nonzero(face >= 0)[:, 0]
        face, origins = face[rows], origins[rows]
        weights = meet(origins, down.expand_as(origins), flat[face]).weights.clamp(0, 1).double()
        weights = weights / weights.sum(-1, keepdim=True)
        yield Texels(number[rows].numpy(), face.numpy(), weights.numpy())


def dilate(
    texture: UInt8[np.ndarray, "S S C"], covered: Bool[np.ndarray, "S S"]
) -> UInt8[np.ndarray, "S S C"]:
    """The texture with what the nearest covered texel holds in every other, so that no look-up between texels
    or in a smaller copy of the texture meets a colour that is not of the surface."""
    rows, columns = distance_transform_edt(~covered, return_distances=False, return_indices=True)
    return texture[rows, columns]
