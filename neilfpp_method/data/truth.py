"""The ground truth of a capture, where it is at hand: depth, normals, masks, materials, mesh and light field.

Everything is optional and read when asked for. What belongs to a view is flat, row by row, as in
`PixelDataset.view`. Where a view has fewer pixels than its files, a pixel shows a surface if all of its area
does; its depth is that at its centre, all else the mean over its area. All positions, lengths and directions
are in the scene frame.

    <inputs>/depth_maps/<stem>.exr                    depth along the camera's axis, world units; 0: none
    <inputs>/normal_maps/<stem>.exr                   unit normals, world axes; 0: none
    <inputs>/model/mesh.ply                           the surface, world frame
    ground_truths/materials/{kd,roughness,metallic}/  <stem>.png, linear, usually for the test views alone
    light/light_field_gt.npz                          incident and outgoing radiance at surface points
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from neilfpp_method.data.capture import Capture
from neilfpp_method.data.images import read_image
from neilfpp_method.data.mesh import Mesh, read_mesh
from neilfpp_method.data.scaling import area_average, area_share, file_size, nearest
from neilfpp_method.data.views import View, inside
from neilfpp_method.errors import UserError
from neilfpp_method.structures import Material

__all__ = ["LightField", "Truth"]


@dataclass(frozen=True)
class LightField:
    """Radiance at N surface points: what arrives from S directions `wi` and what leaves in K directions `wo`.

    Directions are unit and point away from the surface. Each `wi` stands for 2π/S of the hemisphere.
    """

    position: Float[Tensor, "N 3"]
    normal: Float[Tensor, "N 3"]
    material: Material
    wi: Float[Tensor, "N S 3"]
    incident: Float[Tensor, "N S 3"]
    wo: Float[Tensor, "N K 3"]
    outgoing: Float[Tensor, "N K 3"]


@dataclass(frozen=True)
class Truth:
    """What is known of a capture besides its images. Each method returns none where its files are not there.

    Raises (each method):
        UserError: a file is there and cannot be read, or does not have the view's size.
    """

    capture: Capture

    def depth(self, view: View) -> Float[Tensor, " P"] | None:
        """Depth along the camera's axis in scene units, 0 on the background."""
        pixels = self._pixels(
            self.capture.inputs / "depth_maps" / f"{view.name}.exr", view, channels=1, mean=False
        )
        return None if pixels is None else pixels[:, 0] / self.capture.normalisation.scale

    def mask(self, view: View) -> Bool[Tensor, " P"] | None:
        """Where the depth map shows a surface."""
        depth = self.depth(view)
        return None if depth is None else depth > 0

    def normal(self, view: View) -> Float[Tensor, "P 3"] | None:
        """Unit normals, 0 on the background; the world's axes are the scene's."""
        pixels = self._pixels(self.capture.inputs / "normal_maps" / f"{view.name}.exr", view, channels=3)
        return None if pixels is None else torch.nn.functional.normalize(pixels, dim=-1)

    def material(self, view: View) -> Material | None:
        """Base colour, roughness and metallic, 0 on the background; none unless all three are there."""
        folder = self.capture.root / "ground_truths" / "materials"
        base_color, roughness, metallic = (
            self._pixels(folder / name / f"{view.name}.png", view, channels)
            for name, channels in (("kd", 3), ("roughness", 1), ("metallic", 1))
        )
        if base_color is None or roughness is None or metallic is None:
            return None
        return Material(base_color, roughness, metallic)

    def mesh(self) -> Mesh | None:
        """The surface."""
        path = self._file(self.capture.inputs / "model" / "mesh.ply")
        return None if path is None else read_mesh(path, self.capture.normalisation)

    def light_field(self) -> LightField | None:
        """Incident and outgoing radiance at surface points."""
        path = self._file(self.capture.root / "light" / "light_field_gt.npz")
        if path is None:
            return None
        try:
            with np.load(path, allow_pickle=False) as arrays:
                get = {name: torch.from_numpy(arrays[name].astype(np.float32)) for name in arrays.files}
            (n, s, _), (_, k, _) = get["wi"].shape, get["wo"].shape
            shapes = {
                "points": (n, 3),
                "normals": (n, 3),
                "base_color": (n, 3),
                "roughness": (n,),
                "metallic": (n,),
            }
            shapes |= {"wi": (n, s, 3), "incident": (n, s, 3), "wo": (n, k, 3), "outgoing": (n, k, 3)}
            for name, shape in shapes.items():
                if get[name].shape != shape:
                    raise ValueError(f"{name} has the shape {tuple(get[name].shape)}, not {shape}")
        except Exception as error:  # a damaged archive raises what zipfile, zlib and numpy please
            raise UserError(
                f"{path}: not a light field ({error})", "remove the file, or write it again"
            ) from error
        return LightField(
            position=self.capture.normalisation.to_scene(get["points"]),
            normal=get["normals"],
            material=Material(get["base_color"], get["roughness"][:, None], get["metallic"][:, None]),
            wi=get["wi"],
            incident=get["incident"],
            wo=get["wo"],
            outgoing=get["outgoing"],
        )

    def _file(self, path: Path) -> Path | None:
        return path if inside(self.capture.root, path).is_file() else None

    def _pixels(
        self, path: Path, view: View, channels: int, mean: bool = True
    ) -> Float[Tensor, "P C"] | None:
        """The pixels of a file, flat."""
        if self._file(path) is None:
            return None
        pixels = read_image(path).pixels
        if channels == 1 and (pixels == pixels[..., :1]).all():
            pixels = pixels[..., :1]  # many programs write grey as three channels that are alike
        wanted = (*file_size(view)[::-1], channels)
        if pixels.shape != wanted:
            raise UserError(
                f"{path}: the shape {pixels.shape}, where the view needs {wanted}", "render it again"
            )
        if not np.isfinite(pixels).all():
            raise UserError(f"{path}: a pixel is not finite", "render it again")
        size = (view.camera.width, view.camera.height)
        if size != file_size(view):
            covered = (
                area_share((pixels != 0).any(-1), *size) > 1 - 1e-6 if not mean else np.ones(size[::-1], bool)
            )
            pixels = np.where(
                covered[..., None], (area_average if mean else nearest)(pixels, *size), np.float32(0.0)
            )
        return torch.from_numpy(pixels).reshape(-1, channels)
