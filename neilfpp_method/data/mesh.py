"""Triangle meshes of a capture, in the scene frame."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import trimesh
from jaxtyping import Float, Int
from torch import Tensor

from neilfpp_method.data.views import Normalisation
from neilfpp_method.errors import UserError

__all__ = ["Mesh", "read_mesh"]


@dataclass(frozen=True)
class Mesh:
    """Triangles in the scene frame."""

    vertices: Float[Tensor, "V 3"]
    faces: Int[Tensor, "F 3"]


def read_mesh(path: Path, normalisation: Normalisation) -> Mesh:
    """A mesh from a file in the world frame; vertices stay as they are, the ones at the same place too.

    Raises:
        UserError: no such file, or it holds no triangles that can be used.
    """
    if not path.is_file():
        raise UserError(
            f"{path}: there is no such mesh", "give the path of a triangle mesh, such as a PLY file"
        )
    try:
        mesh = trimesh.load_mesh(path, process=False)
        vertices = torch.as_tensor(np.array(mesh.vertices), dtype=torch.float32)
        faces = torch.as_tensor(np.array(mesh.faces), dtype=torch.int64)
    except Exception as error:  # whatever trimesh meets in a damaged file
        raise UserError(f"{path}: not a mesh that can be read ({error})", "export it again as PLY") from error
    if not len(faces) or not vertices.isfinite().all() or faces.min() < 0 or faces.max() >= len(vertices):
        raise UserError(
            f"{path}: no triangles, or triangles of vertices that are not there", "export it again"
        )
    return Mesh(normalisation.to_scene(vertices), faces)
