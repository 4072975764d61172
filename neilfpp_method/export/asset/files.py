"""The files of an asset (docs/assets.md)."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

import numpy as np
import trimesh

from neilfpp_method.data.images import write_exr, write_png
from neilfpp_method.export.asset.atlas import Unwrapped
from neilfpp_method.export.asset.bake import Textures
from neilfpp_method.export.asset.described import describe_scene
from neilfpp_method.export.asset.environment import equirectangular
from neilfpp_method.export.asset.folder import filling
from neilfpp_method.export.asset.glb import glb_bytes
from neilfpp_method.export.asset.usd import has_usd, usd_text
from neilfpp_method.fields.environment import EnvironmentLight
from neilfpp_method.train.run import Run, write_json

__all__ = ["write_asset"]

SCRIPTS = ("open_in_blender.py", "open_in_mitsuba.py")


def write_asset(run: Run, mesh: Unwrapped, textures: Textures, out: Path) -> None:
    """Write everything, or nothing.

    Args:
        run: knows light, cameras and the frame.
        mesh: vertices and normals in the world frame.
        textures: of its atlas.
        out: the folder.

    Raises:
        UserError: it cannot be written.
    """
    light = run.model.light
    radiance = light.log_radiance.exp().cpu() if isinstance(light, EnvironmentLight) else None
    described = describe_scene(run, environment=radiance is not None)
    pictures = {
        "base_color": textures.base_color,
        "metallic_roughness": textures.metallic_roughness(),
        "roughness": textures.roughness,
        "metallic": textures.metallic,
        "normal": textures.normal,
        **({} if textures.deviation is None else {"deviation": textures.deviation}),
    }
    with filling(out) as folder:
        for name, picture in pictures.items():
            write_png(folder / "textures" / f"{name}.png", picture)
        (folder / "asset.glb").write_bytes(glb_bytes(mesh, textures, described["lamps"]))
        if has_usd():
            (folder / "asset.usda").write_text(usd_text(mesh, described["lamps"]))
        (folder / "mesh.ply").write_bytes(_ply(mesh))
        if radiance is not None:
            write_exr(folder / "environment.exr", {"RGB": radiance.permute(1, 2, 0).numpy()})
            for program in ("blender", "unreal"):
                write_exr(
                    folder / f"environment_{program}.exr", {"RGB": equirectangular(radiance, program).numpy()}
                )
        write_json(folder / "scene.json", described)
        for name in SCRIPTS:
            source = resources.files("neilfpp_method.export.asset.scripts") / name
            (folder / name).write_text(source.read_text("utf-8"), "utf-8")


def _ply(mesh: Unwrapped) -> bytes:
    """With texture places u and v, v upwards, for programs that read no glTF."""
    shape = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_normals=mesh.normals, process=False)
    u, v = mesh.uv.astype(np.float32).T
    shape.vertex_attributes.update(u=u, v=v)
    return shape.export(file_type="ply", vertex_normal=True)
