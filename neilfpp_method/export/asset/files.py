"""Write the files of an asset (docs/assets.md)."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

import numpy as np

from neilfpp_method.data.files.images import write_exr, write_png
from neilfpp_method.data.files.json_entry import write_json
from neilfpp_method.data.files.ply import NORMAL, write_ply
from neilfpp_method.export.asset.atlas import Unwrapped
from neilfpp_method.export.asset.bake import Textures
from neilfpp_method.export.asset.environment import equirectangular
from neilfpp_method.export.asset.folder import filling
from neilfpp_method.export.asset.glb import glb_bytes
from neilfpp_method.export.asset.scene_file import describe_scene
from neilfpp_method.export.asset.usd import has_usd, usd_text
from neilfpp_method.fields.environment import EnvironmentLight
from neilfpp_method.train.run import Run

__all__ = ["write_asset"]

SCRIPTS = ("open_in_blender.py", "open_in_mitsuba.py")


def write_asset(run: Run, mesh: Unwrapped, textures: Textures, out: Path) -> None:
    """Write all files of an asset atomically.

    Args:
        run: the run, for light and cameras.
        mesh: the unwrapped surface, with vertices and normals in the world frame.
        textures: the textures of `mesh`.
        out: the folder to write.

    Raises:
        UserError: the folder cannot be written.
    """
    light = run.model.light
    radiance = light.log_radiance.exp().cpu() if isinstance(light, EnvironmentLight) else None
    scene = describe_scene(run, environment=radiance is not None)
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
        (folder / "asset.glb").write_bytes(glb_bytes(mesh, textures, scene["lamps"]))
        if has_usd():
            (folder / "asset.usda").write_text(usd_text(mesh, scene["lamps"]), "utf-8")
        # Texture coordinates u and v, v upwards, for programs that do not read glTF.
        rows = np.concatenate((mesh.normals, mesh.uv), axis=1).astype(np.float32)
        columns = dict(zip((*NORMAL, "u", "v"), rows.T, strict=True))
        write_ply(folder / "mesh.ply", mesh.vertices, columns, mesh.faces)
        if radiance is not None:
            write_exr(folder / "environment.exr", {"RGB": radiance.permute(1, 2, 0).numpy()})
            for program in ("blender", "unreal"):
                resampled = equirectangular(radiance, program).numpy()
                write_exr(folder / f"environment_{program}.exr", {"RGB": resampled})
        write_json(folder / "scene.json", scene)
        for name in SCRIPTS:
            source = resources.files("neilfpp_method.export.asset.scripts") / name
            (folder / name).write_text(source.read_text("utf-8"), "utf-8")
