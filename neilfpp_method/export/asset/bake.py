"""Bake the textures of an asset: the material at the surface point of each texel, and the fine normals."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, UInt8

from neilfpp_method.export.asset.atlas import Unwrapped
from neilfpp_method.export.asset.surface import AssetSurface, first_hits, hits_along_normals
from neilfpp_method.export.asset.tangents import vertex_tangents
from neilfpp_method.export.asset.texels import covered_texels, dilate
from neilfpp_method.export.mesh import materials_in_parts
from neilfpp_method.shading.color import tone_map
from neilfpp_method.train.run import Run

__all__ = ["Detail", "Textures", "bake"]

CHANNELS = {
    "base_color": slice(0, 3),
    "roughness": slice(3, 4),
    "metallic": slice(4, 5),
    "normal": slice(5, 8),
}
"""Channels of the array that all textures are baked into; expected errors follow after them."""
FIRST_ERROR, CHANNELS_WITH_ERRORS = 8, 11
"""Channel of the first expected error, and number of channels if there are three of them."""


@dataclass(frozen=True)
class Textures:
    """Textures with 8 bits per channel; the first row is at v = 1.

    Attributes:
        base_color: base colour, sRGB-encoded.
        roughness: roughness, linear.
        metallic: metallic, linear.
        normal: 127.5 + 127.5 · (x along the tangent, y along the bitangent, z along the normal), the OpenGL
            convention with green up.
        covered: fraction of the texels that show the surface.
        deviation: expected errors of base colour, roughness and metallic, 255 for 1; None if not computed.
    """

    base_color: UInt8[np.ndarray, "S S 3"]
    roughness: UInt8[np.ndarray, "S S 1"]
    metallic: UInt8[np.ndarray, "S S 1"]
    normal: UInt8[np.ndarray, "S S 3"]
    covered: float
    deviation: UInt8[np.ndarray, "S S 3"] | None

    def metallic_roughness(self) -> UInt8[np.ndarray, "S S 3"]:
        """Pack as in glTF: roughness in green, metallic in blue. Red, which may hold occlusion, is white."""
        return np.concatenate([np.full_like(self.roughness, 255), self.roughness, self.metallic], axis=-1)


@dataclass(frozen=True)
class Detail:
    """What the textures show: the fine surface, and its largest distance from the coarse one, scene units."""

    surface: AssetSurface
    reach: float


@torch.no_grad()
def bake(
    run: Run,
    mesh: Unwrapped,
    detail: Detail,
    size: int,
    deviation: Float[np.ndarray, "V 3"] | None = None,
    on_progress: Callable[[float], None] = lambda share: None,
) -> Textures:
    """Evaluate the material and the normal of a run at every texel.

    The point of a texel on the coarse surface is moved along the normal onto the fine surface, if that is
    within reach. Material and normal are taken at the moved point.

    Args:
        run: the run.
        mesh: the coarse surface, unwrapped.
        detail: the fine surface of the run, and its reach.
        size: width and height of the textures.
        deviation: expected errors at the vertices of `mesh`; None for no such texture.
        on_progress: called with the fraction of the work that is done.
    """
    tracer, tangents = first_hits(detail.surface), vertex_tangents(mesh)
    texture = np.zeros((size * size, FIRST_ERROR if deviation is None else CHANNELS_WITH_ERRORS), np.uint8)
    covered = np.zeros(size * size, bool)
    for texels in covered_texels(mesh, size):
        position = texels.interpolate(mesh.vertices, mesh.faces)
        normal = texels.interpolate(mesh.normals, mesh.faces)
        tangent = texels.interpolate(tangents[:, :3], mesh.faces)
        sign = tangents[mesh.faces[texels.face, 0], 3:]
        unit_normal = normal / np.linalg.norm(normal, axis=-1, keepdims=True).clip(1e-12)
        hits = hits_along_normals(detail.surface, tracer, position, unit_normal, detail.reach)
        points = torch.as_tensor(hits.position, dtype=torch.float32, device=run.device)
        material = materials_in_parts(run, points)
        values = [
            tone_map(material.base_color).cpu().numpy(),
            material.roughness.cpu().numpy(),
            material.metallic.cpu().numpy(),
            0.5 + 0.5 * tangent_space(hits.normal, tangent, sign * np.cross(normal, tangent), normal),
            *([] if deviation is None else [texels.interpolate(deviation, mesh.faces)]),
        ]
        texture[texels.number] = np.rint(255 * np.concatenate(values, axis=1).clip(0, 1)).astype(np.uint8)
        covered[texels.number] = True
        on_progress(texels.done)
    dilated = dilate(texture.reshape(size, size, -1), covered.reshape(size, size))
    return Textures(
        **{name: dilated[..., channels] for name, channels in CHANNELS.items()},
        covered=float(covered.mean()),
        deviation=None if deviation is None else dilated[..., FIRST_ERROR:],
    )


def tangent_space(
    vector: Float[np.ndarray, "N 3"],
    tangent: Float[np.ndarray, "N 3"],
    bitangent: Float[np.ndarray, "N 3"],
    normal: Float[np.ndarray, "N 3"],
) -> Float[np.ndarray, "N 3"]:
    """Express directions in the tangent frame that a renderer interpolates.

    That frame is neither orthogonal nor normalised, so the result solves
    x · tangent + y · bitangent + z · normal ∝ vector and is then normalised. It is (0, 0, 1) if the frame is
    singular.
    """
    frame = np.stack([tangent, bitangent, normal], axis=-1)
    singular = np.abs(np.linalg.det(frame)) < 1e-6
    frame[singular] = np.eye(3)
    local = np.linalg.solve(frame, vector[..., None])[..., 0]
    local[singular] = [0.0, 0.0, 1.0]
    return local / np.linalg.norm(local, axis=-1, keepdims=True).clip(1e-12)
