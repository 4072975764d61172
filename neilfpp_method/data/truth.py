"""Read the ground truth of a capture: depth, normals, masks, materials, mesh and light field.

Every file is optional and is read by the method that needs it. Maps of a view are flat, row by row, as in
`PixelDataset.view`. If a view has fewer pixels than its files, a pixel shows a surface if its whole area
does; its depth is that at its centre, and all other values are means over its area. All positions, lengths
and directions that the methods return are in the scene frame.

    <inputs>/depth_maps/<stem>.exr     depth along the camera's axis, world units; 0: no surface
    <inputs>/normal_maps/<stem>.exr    unit normals, world axes; 0: no surface
    <inputs>/model/mesh.ply            the surface, world frame
    ground_truths/materials/*/<stem>.png    kd, roughness, metallic; linear, usually only for the test views
    light/light_field_gt.npz           incident and outgoing radiance at surface points
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32
from torch import Tensor

from neilfpp_method.data.capture import Capture
from neilfpp_method.data.files.images import read_image
from neilfpp_method.data.files.number_arrays import arrays_of_archive
from neilfpp_method.data.files.paths import inside
from neilfpp_method.data.mesh import Mesh, read_mesh
from neilfpp_method.data.scaling import area_average, area_share, file_size, nearest
from neilfpp_method.data.views import View
from neilfpp_method.errors import UserError
from neilfpp_method.structures import Material

__all__ = ["LightField", "Truth"]

LARGEST_LIGHT_FIELD = 2**29
"""Largest unpacked size of a light field, in bytes: 4,096 points with 4,096 directions have 400 million."""


@dataclass(frozen=True)
class LightField:
    """Radiance at N surface points: incident from S directions `wi`, and outgoing in K directions `wo`.

    Directions are unit vectors that point away from the surface. Each `wi` represents a solid angle of 2π/S
    of the hemisphere.
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
    """The ground truth of a capture. Each method returns None if its files do not exist.

    Raises (each method):
        UserError: a file exists but cannot be read, or does not have the size of the view.
    """

    capture: Capture

    def depth(self, view: View) -> Float[Tensor, " P"] | None:
        """Return the depth along the camera's axis in scene units, 0 on the background."""
        values = self._read(self.capture.inputs / "depth_maps" / f"{view.name}.exr", view, channels=1)
        if values is None:
            return None
        size = (view.camera.width, view.camera.height)
        covered = area_share((values != 0).any(-1), *size) > 1 - 1e-6
        depth = np.where(covered, nearest(values, *size)[..., 0], np.float32(0.0))
        return torch.from_numpy(depth).reshape(-1) / self.capture.normalization.scale

    def mask(self, view: View) -> Bool[Tensor, " P"] | None:
        """Return which pixels show a surface, according to the depth map."""
        depth = self.depth(view)
        return None if depth is None else depth > 0

    def normal(self, view: View) -> Float[Tensor, "P 3"] | None:
        """Return unit normals, 0 on the background. World frame and scene frame have the same axes."""
        pixels = self._mean(self.capture.inputs / "normal_maps" / f"{view.name}.exr", view, channels=3)
        return None if pixels is None else torch.nn.functional.normalize(pixels, dim=-1)

    def material(self, view: View) -> Material | None:
        """Return base colour, roughness and metallic, 0 on the background; None if a map is missing."""
        folder = self.capture.root / "ground_truths" / "materials"
        base_color, roughness, metallic = (
            self._mean(folder / name / f"{view.name}.png", view, channels)
            for name, channels in (("kd", 3), ("roughness", 1), ("metallic", 1))
        )
        if base_color is None or roughness is None or metallic is None:
            return None
        return Material(base_color, roughness, metallic)

    def mesh(self) -> Mesh | None:
        """Return the surface."""
        path = self._file(self.capture.inputs / "model" / "mesh.ply")
        return None if path is None else read_mesh(path, self.capture.normalization)

    def light_field(self) -> LightField | None:
        """Return incident and outgoing radiance at surface points."""
        path = self._file(self.capture.root / "light" / "light_field_gt.npz")
        if path is None:
            return None
        try:
            stored = arrays_of_archive(path, LARGEST_LIGHT_FIELD)
            arrays = {name: torch.from_numpy(values.astype(np.float32)) for name, values in stored.items()}
            (n, s, _), (_, k, _) = arrays["wi"].shape, arrays["wo"].shape
            shapes = {
                "points": (n, 3),
                "normals": (n, 3),
                "base_color": (n, 3),
                "roughness": (n,),
                "metallic": (n,),
            }
            shapes |= {"wi": (n, s, 3), "incident": (n, s, 3), "wo": (n, k, 3), "outgoing": (n, k, 3)}
            for name, shape in shapes.items():
                if arrays[name].shape != shape:
                    raise ValueError(f"{name} has the shape {tuple(arrays[name].shape)}, not {shape}")
                if not arrays[name].isfinite().all():
                    raise ValueError(f"{name} has a value that is not finite")
        except Exception as error:
            # Text, missing arrays and wrong numbers of axes raise different types of exceptions.
            raise UserError(
                f"{path}: not a light field ({error})", "remove the file, or write it again"
            ) from error
        return LightField(
            position=self.capture.normalization.to_scene(arrays["points"]),
            normal=arrays["normals"],
            material=Material(
                arrays["base_color"], arrays["roughness"][:, None], arrays["metallic"][:, None]
            ),
            wi=arrays["wi"],
            incident=arrays["incident"],
            wo=arrays["wo"],
            outgoing=arrays["outgoing"],
        )

    def _file(self, path: Path) -> Path | None:
        return path if inside(self.capture.root, path).is_file() else None

    def _mean(self, path: Path, view: View, channels: int) -> Float[Tensor, "P C"] | None:
        """The means of a file over the areas of the pixels of a view, row by row."""
        values = self._read(path, view, channels)
        if values is None:
            return None
        mean = area_average(values, view.camera.width, view.camera.height)
        return torch.from_numpy(mean).reshape(-1, channels)

    def _read(self, path: Path, view: View, channels: int) -> Float32[np.ndarray, "H W C"] | None:
        """The pixels of a file, which must have the size of the files of the view."""
        if self._file(path) is None:
            return None
        pixels = read_image(path).pixels
        if channels == 1 and (pixels == pixels[..., :1]).all():
            # Many programs write a grey image with three equal channels.
            pixels = pixels[..., :1]
        wanted = (*file_size(view)[::-1], channels)
        if pixels.shape != wanted:
            raise UserError(
                f"{path}: the shape {pixels.shape}, where the view needs {wanted}", "render it again"
            )
        if not np.isfinite(pixels).all():
            raise UserError(f"{path}: a pixel is not finite", "render it again")
        return pixels
