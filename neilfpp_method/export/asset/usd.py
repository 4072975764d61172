"""Encode an asset as USD text: UsdPreviewSurface with external textures, Z up, metres, lamps as UsdLux."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from neilfpp_method.data.native_signals import signals_delayed
from neilfpp_method.export.asset.atlas import Unwrapped

try:
    with signals_delayed():
        from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux, UsdShade, Vt
# usd-core is optional: the extra `usd`.
except ImportError:
    Usd = None

__all__ = ["has_usd", "usd_text"]


def has_usd() -> bool:
    """Whether usd-core is installed."""
    return Usd is not None


def usd_text(mesh: Unwrapped, lamps: Sequence[Mapping[str, Any]]) -> str:
    """Return the contents of a .usda file, which refers to the textures in `./textures/`.

    Args:
        mesh: the unwrapped surface, with vertices and normals in the world frame.
        lamps: the lamps in the format of `lamps.json`. Their radiance becomes the luminance of the lights
            without conversion.
    """
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/asset").GetPrim())
    shape = UsdGeom.Mesh.Define(stage, "/asset/surface")
    points = (mesh.vertices - mesh.origin).astype(np.float32)
    if mesh.origin.any():
        shape.AddTranslateOp().Set(Gf.Vec3d(*mesh.origin.tolist()))
    shape.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
    shape.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(mesh.faces), 3, np.int32)))
    shape.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(mesh.faces.astype(np.int32).ravel()))
    shape.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(mesh.normals.astype(np.float32)))
    shape.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    shape.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    shape.CreateDoubleSidedAttr(True)
    extent = np.stack([points.min(0), points.max(0)])
    shape.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(extent))
    texture_coordinates = UsdGeom.PrimvarsAPI(shape).CreatePrimvar(
        "st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.vertex
    )
    texture_coordinates.Set(Vt.Vec2fArray.FromNumpy(mesh.uv.astype(np.float32)))
    UsdShade.MaterialBindingAPI.Apply(shape.GetPrim()).Bind(_material(stage))
    for number, lamp in enumerate(lamps):
        _lamp(stage, f"/asset/lamp_{number}", lamp)
    return stage.GetRootLayer().ExportToString()


def _material(stage: Any) -> Any:
    material = UsdShade.Material.Define(stage, "/asset/material")
    surface = UsdShade.Shader.Define(stage, "/asset/material/surface")
    surface.CreateIdAttr("UsdPreviewSurface")
    reader = UsdShade.Shader.Define(stage, "/asset/material/texture_coordinates")
    reader.CreateIdAttr("UsdPrimvarReader_float2")
    reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("st")
    coordinates = reader.CreateOutput("result", Sdf.ValueTypeNames.Float2)

    def texture(name: str, space: str) -> Any:
        shader = UsdShade.Shader.Define(stage, f"/asset/material/{name}")
        shader.CreateIdAttr("UsdUVTexture")
        shader.CreateInput("file", Sdf.ValueTypeNames.Asset).Set(f"./textures/{name}.png")
        shader.CreateInput("sourceColorSpace", Sdf.ValueTypeNames.Token).Set(space)
        shader.CreateInput("st", Sdf.ValueTypeNames.Float2).ConnectToSource(coordinates)
        return shader

    def connect(name: str, kind: Any, shader: Any, channel: str) -> None:
        output = Sdf.ValueTypeNames.Float3 if channel == "rgb" else Sdf.ValueTypeNames.Float
        surface.CreateInput(name, kind).ConnectToSource(shader.CreateOutput(channel, output))

    packed, normal = texture("metallic_roughness", "raw"), texture("normal", "raw")
    normal.CreateInput("scale", Sdf.ValueTypeNames.Float4).Set(Gf.Vec4f(2, 2, 2, 1))
    normal.CreateInput("bias", Sdf.ValueTypeNames.Float4).Set(Gf.Vec4f(-1, -1, -1, 0))
    connect("diffuseColor", Sdf.ValueTypeNames.Color3f, texture("base_color", "sRGB"), "rgb")
    connect("roughness", Sdf.ValueTypeNames.Float, packed, "g")
    connect("metallic", Sdf.ValueTypeNames.Float, packed, "b")
    connect("normal", Sdf.ValueTypeNames.Normal3f, normal, "rgb")
    surface.CreateInput("useSpecularWorkflow", Sdf.ValueTypeNames.Int).Set(0)
    surface.CreateInput("ior", Sdf.ValueTypeNames.Float).Set(1.5)
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", Sdf.ValueTypeNames.Token))
    return material


def _lamp(stage: Any, path: str, lamp: Mapping[str, Any]) -> None:
    """Add a bulb as a sphere, or a panel as a disk, which emits along −Z with constant radiance."""
    panel = lamp["axis"] is not None
    light = (UsdLux.DiskLight if panel else UsdLux.SphereLight).Define(stage, path)
    brightest = max(lamp["radiance"])
    light.CreateRadiusAttr(lamp["radius"])
    light.CreateIntensityAttr(brightest)
    light.CreateColorAttr(
        Gf.Vec3f(*(channel / brightest if brightest > 0 else 1.0 for channel in lamp["radiance"]))
    )
    pose = UsdGeom.Xformable(light)
    pose.AddTranslateOp().Set(Gf.Vec3d(*lamp["position"]))
    if panel:
        rotation = Gf.Rotation(Gf.Vec3d(0, 0, -1), Gf.Vec3d(*lamp["axis"])).GetQuat()
        pose.AddOrientOp().Set(Gf.Quatf(rotation))
