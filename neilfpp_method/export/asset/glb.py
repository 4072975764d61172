"""An asset as binary glTF: Y up, metres, textures inside, lamps by KHR_lights_punctual."""

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
"""(x, y, z) → (x, z, −y): Z is up in a capture's world and Y in glTF. Blender turns it back."""
EXTENSION = "KHR_lights_punctual"


def glb_bytes(mesh: Unwrapped, textures: Textures, lamps: Sequence[Mapping[str, Any]]) -> bytes:
    """The file's contents.

    Args:
        mesh: vertices and normals in the world frame.
        textures: of its atlas.
        lamps: as `lamps_in_world` has them. Intensities become candela, as they are: glTF's factors from watt
            to lumen know nothing of the units of a capture.
    """
    material = PBRMaterial(
        name="recovered",
        baseColorTexture=Image.fromarray(textures.base_color),
        metallicRoughnessTexture=Image.fromarray(textures.metallic_roughness()),
        normalTexture=Image.fromarray(textures.normal),
        baseColorFactor=[255, 255, 255, 255],
        metallicFactor=1.0,
        roughnessFactor=1.0,
        # Where nobody looked the surface is open, and shows its inside.
        doubleSided=True,
    )
    tangents = vertex_tangents(mesh)
    turned = np.concatenate([tangents[:, :3] @ WORLD_TO_GLTF.T, tangents[:, 3:]], axis=1)
    shape = trimesh.Trimesh(
        mesh.vertices @ WORLD_TO_GLTF.T,
        mesh.faces,
        vertex_normals=mesh.normals @ WORLD_TO_GLTF.T,
        visual=TextureVisuals(uv=mesh.uv, material=material),
        vertex_attributes={"_TANGENT": turned.astype(np.float32)},
        process=False,
    )

    def finish(tree: dict[str, Any]) -> None:
        for part in (primitive for written in tree["meshes"] for primitive in written["primitives"]):
            part["attributes"]["TANGENT"] = part["attributes"].pop("_TANGENT")
        if lamps:
            _add_lamps(tree, lamps)

    return export_glb(trimesh.Scene({"surface": shape}), include_normals=True, tree_postprocessor=finish)


def _add_lamps(tree: dict[str, Any], lamps: Sequence[Mapping[str, Any]]) -> None:
    lights = []
    for number, lamp in enumerate(lamps):
        brightest = max(lamp["intensity"])
        light = {
            "name": f"lamp {number}",
            "type": "point" if lamp["axis"] is None else "spot",
            "color": [channel / brightest for channel in lamp["intensity"]]
            if brightest > 0
            else [1.0, 1.0, 1.0],
            "intensity": brightest,
        }
        node = {
            "name": light["name"],
            "translation": (WORLD_TO_GLTF @ np.array(lamp["position"])).tolist(),
            "extensions": {EXTENSION: {"light": number}},
        }
        if lamp["axis"] is not None:
            # The widest cone: cos² θ by the specification's own falloff, where ours is cos θ.
            light["spot"] = {"innerConeAngle": 0.0, "outerConeAngle": math.pi / 2}
            node["rotation"] = _turn_from_minus_z(WORLD_TO_GLTF @ np.array(lamp["axis"]))
        lights.append(light)
        tree["scenes"][tree.get("scene", 0)]["nodes"].append(len(tree["nodes"]))
        tree["nodes"].append(node)
    tree.setdefault("extensionsUsed", []).append(EXTENSION)
    tree.setdefault("extensions", {})[EXTENSION] = {"lights": lights}


def _turn_from_minus_z(axis: Float[np.ndarray, " 3"]) -> list[float]:
    """The quaternion (x, y, z, w) of a turn that takes −Z, where a spot looks, to a unit axis."""
    half = np.array([axis[1], -axis[0], 0.0, 1.0 - axis[2]])  # −Z × axis, and 1 + −Z · axis
    length = np.linalg.norm(half)
    return [1.0, 0.0, 0.0, 0.0] if length < 1e-6 else (half / length).tolist()
