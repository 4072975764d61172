"""Textures of an asset: the material at the surface point of each texel, and the fine surface's normal."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, UInt8

from neilfpp_method.export.asset.atlas import Unwrapped
from neilfpp_method.export.asset.surface import Surface, first_hits, meet_along
from neilfpp_method.export.asset.tangents import vertex_tangents
from neilfpp_method.export.asset.texels import covered_texels, dilate
from neilfpp_method.export.mesh import materials_in_parts
from neilfpp_method.shading.color import tone_map
from neilfpp_method.train.run import Run

__all__ = ["Textures", "bake"]

CHANNELS = {
    "base_color": slice(0, 3),
    "roughness": slice(3, 4),
    "metallic": slice(4, 5),
    "normal": slice(5, 8),
}


@dataclass(frozen=True)
class Textures:
    """8 bits a channel, the first row at v = 1.

    Attributes:
        base_color: sRGB-encoded.
        roughness: linear.
        metallic: linear.
        normal: 127.5 + 127.5 · (x along the tangent, y along the bitangent, z along the normal): "OpenGL",
            green up.
        covered: the share of the texels that show the surface.
        deviation: how far off base colour, roughness and metallic may be, 255 for 1; none where that was not
            asked for.
    """

    base_color: UInt8[np.ndarray, "S S 3"]
    roughness: UInt8[np.ndarray, "S S 1"]
    metallic: UInt8[np.ndarray, "S S 1"]
    normal: UInt8[np.ndarray, "S S 3"]
    covered: float
    deviation: UInt8[np.ndarray, "S S 3"] | None

    def metallic_roughness(self) -> UInt8[np.ndarray, "S S 3"]:
        """As glTF packs it: roughness in green, metallic in blue; red (occlusion elsewhere) is white."""
        return np.concatenate([np.full_like(self.roughness, 255), self.roughness, self.metallic], axis=-1)


@torch.no_grad()
def bake(
    run: Run,
    mesh: Unwrapped,
    fine: Surface,
    reach: float,
    size: int,
    deviation: Float[np.ndarray, "V 3"] | None = None,
    on_progress: Callable[[float], None] = lambda share: None,
) -> Textures:
    """Ask the run at every texel.

    A texel's point of the coarse surface is moved along the normal onto the fine one, where that is near;
    there the material is asked for, and there the normal is taken.

    Args:
        run: knows the material.
        mesh: the coarse surface on its texture.
        fine: the surface that the run has.
        reach: how far that may be from the coarse one, scene units.
        size: of the textures.
        deviation: at the vertices; none: no such texture.
        on_progress: told the share that is done.
    """
    device = next(run.model.parameters()).device
    tracer, tangents = first_hits(fine), vertex_tangents(mesh)
    texture = np.zeros((size * size, 8 if deviation is None else 11), np.uint8)
    covered = np.zeros(size * size, bool)
    for texels in covered_texels(mesh, size):
        position = texels.interpolate(mesh.vertices, mesh.faces)
        normal = texels.interpolate(mesh.normals, mesh.faces)
        tangent = texels.interpolate(tangents[:, :3], mesh.faces)
        sign = tangents[mesh.faces[texels.face, 0], 3:]
        straight = normal / np.linalg.norm(normal, axis=-1, keepdims=True).clip(1e-12)
        footing = meet_along(fine, tracer, position, straight, reach)
        place = torch.as_tensor(footing.position, dtype=torch.float32, device=device)
        material = materials_in_parts(run, place)
        values = [
            tone_map(material.base_color).cpu().numpy(),
            material.roughness.cpu().numpy(),
            material.metallic.cpu().numpy(),
            0.5 + 0.5 * in_frame(footing.normal, tangent, sign * np.cross(normal, tangent), normal),
            *([] if deviation is None else [texels.interpolate(deviation, mesh.faces)]),
        ]
        texture[texels.number] = np.rint(255 * np.concatenate(values, axis=1).clip(0, 1)).astype(np.uint8)
        covered[texels.number] = True
        on_progress((texels.number[-1] + 1) / size**2 if len(texels.number) else 0.0)
    on_progress(1.0)
    full = dilate(texture.reshape(size, size, -1), covered.reshape(size, size))
    textures = {name: full[..., channels] for name, channels in CHANNELS.items()}
    return Textures(
        **textures, covered=float(covered.mean()), deviation=None if deviation is None else full[..., 8:]
    )


def in_frame(
    vector: Float[np.ndarray, "N 3"],
    tangent: Float[np.ndarray, "N 3"],
    bitangent: Float[np.ndarray, "N 3"],
    normal: Float[np.ndarray, "N 3"],
) -> Float[np.ndarray, "N 3"]:
    """The unit (x, y, z) for which x · tangent + y · bitangent + z · normal points along the vector:
    renderers interpolate the frame and leave it as it is, neither orthogonal nor of unit length."""
    frame = np.stack([tangent, bitangent, normal], axis=-1)
    singular = np.abs(np.linalg.det(frame)) < 1e-6
    frame[singular] = np.eye(3)
    inside = np.linalg.solve(frame, vector[..., None])[..., 0]
    inside[singular] = [0.0, 0.0, 1.0]
    return inside / np.linalg.norm(inside, axis=-1, keepdims=True).clip(1e-12)
