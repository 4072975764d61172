"""Encode an asset as binary glTF: Y up, metres, embedded textures, lamps as KHR_lights_punctual."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float
from PIL import Image
from trimesh.exchange.gltf import export_glb
from trimesh.visual.material import PBRMaterial
from trimesh.visual.texture import TextureVisuals

from neilfpp_method.export.asset.atlas import Unwrapped
from neilfpp_method.export.asset.bake import Textures
from neilfpp_method.export.asset.tangents import vertex_tangents

__all__ = ["WORLD_TO_GLTF", "glb_bytes"]

WORLD_TO_GLTF = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Rotation (x, y, z) → (x, z, −y): Z is up in a capture's world, Y is up in glTF. Blender's importer inverts
it.
"""
EXTENSION = "KHR_lights_punctual"
"""Name of the glTF extension for lights."""


def glb_bytes(mesh: Unwrapped, textures: Textures, lamps: Sequence[Mapping[str, Any]]) -> bytes:
    """Return the contents of a .glb file.

    Args:
        mesh: the unwrapped surface, with vertices and normals in the world frame.
        textures: the textures of `mesh`.
        lamps: the lamps in the format of `lamps.json`. Intensities are written as candela without conversion,
            because the radiance of a capture has no physical unit.
    """
    material = PBRMaterial(
        name="recovered",
        baseColorTexture=Image.fromarray(textures.base_color),
        metallicRoughnessTexture=Image.fromarray(textures.metallic_roughness()),
        normalTexture=Image.fromarray(textures.normal),
        baseColorFactor=[255, 255, 255, 255],
        metallicFactor=1.0,
        roughnessFactor=1.0,
        # The surface is open at parts that no camera sees, so its inside can be visible.
        doubleSided=True,
    )
    tangents = vertex_tangents(mesh)
    rotated = np.concatenate([tangents[:, :3] @ WORLD_TO_GLTF.T, tangents[:, 3:]], axis=1)
    shape = trimesh.Trimesh(
        (mesh.vertices - mesh.origin) @ WORLD_TO_GLTF.T,
        mesh.faces,
        vertex_normals=mesh.normals @ WORLD_TO_GLTF.T,
        visual=TextureVisuals(uv=mesh.uv, material=material),
        # trimesh writes custom attributes with a leading underscore, which is removed below.
        vertex_attributes={"_TANGENT": rotated.astype(np.float32)},
        process=False,
    )

    def postprocess(tree: dict[str, Any]) -> None:
        for primitive in (primitive for part in tree["meshes"] for primitive in part["primitives"]):
            primitive["attributes"]["TANGENT"] = primitive["attributes"].pop("_TANGENT")
        if lamps:
            _add_lamps(tree, lamps)

    scene = trimesh.Scene()
    placed = trimesh.transformations.translation_matrix(WORLD_TO_GLTF @ mesh.origin)
    scene.add_geometry(shape, node_name="surface", geom_name="surface", transform=placed)
    return export_glb(scene, include_normals=True, tree_postprocessor=postprocess)


def _add_lamps(tree: dict[str, Any], lamps: Sequence[Mapping[str, Any]]) -> None:
    lights = []
    for number, lamp in enumerate(lamps):
        brightest = max(lamp["intensity"])
        color = [channel / brightest if brightest > 0 else 1.0 for channel in lamp["intensity"]]
        light = {
            "name": f"lamp {number}",
            "type": "point" if lamp["axis"] is None else "spot",
            "color": color,
            "intensity": brightest,
        }
        node = {
            "name": light["name"],
            "translation": (WORLD_TO_GLTF @ np.array(lamp["position"])).tolist(),
            "extensions": {EXTENSION: {"light": number}},
        }
        if lamp["axis"] is not None:
            # The widest cone that the extension allows. Its falloff is cos² θ; that of a panel is cos θ.
            light["spot"] = {"innerConeAngle": 0.0, "outerConeAngle": math.pi / 2}
            node["rotation"] = _rotation_from_minus_z(WORLD_TO_GLTF @ np.array(lamp["axis"]))
        lights.append(light)
        tree["scenes"][tree.get("scene", 0)]["nodes"].append(len(tree["nodes"]))
        tree["nodes"].append(node)
    tree.setdefault("extensionsUsed", []).append(EXTENSION)
    tree.setdefault("extensions", {})[EXTENSION] = {"lights": lights}


def _rotation_from_minus_z(axis: Float[np.ndarray, " 3"]) -> list[float]:
    """Quaternion (x, y, z, w) of a rotation from −Z, the direction of a spot, to a unit axis."""
    # The vector part is −Z × axis, the scalar part 1 + (−Z · axis), before normalisation.
    quaternion = np.array([axis[1], -axis[0], 0.0, 1.0 - axis[2]])
    length = np.linalg.norm(quaternion)
    return [1.0, 0.0, 0.0, 0.0] if length < 1e-6 else (quaternion / length).tolist()
