"""Masks that a person paints over a view, to say where an edit counts: they lie on what the view sees."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from neilfpp_method.data.capture import Capture
from neilfpp_method.data.images import image_header, read_image
from neilfpp_method.data.views import Camera, project
from neilfpp_method.errors import UserError
from neilfpp_method.relight.cameras import resized
from neilfpp_method.relight.edits import Limit
from neilfpp_method.relight.surface import Surface

__all__ = ["Stencil", "painted", "read_stencils"]

NEAR = 2e-3
"""Scene units that a point may lie behind what its view meets first, and be taken for it."""
WHITE = 0.5
"""From this share of white on a pixel is painted."""


@dataclass(frozen=True)
class Stencil:
    """A camera in the scene frame, in the size of the mask, and which of its pixels are painted."""

    camera: Camera
    white: Bool[Tensor, "H W"]

    def covers(self, x: Float[Tensor, "N 3"], surface: Surface) -> Bool[Tensor, "N 1"]:
        """Which points the camera sees through a painted pixel, with nothing of the surface in between."""
        shown = project(self.camera, x)
        column, row = shown.pixel.nan_to_num(-1.0, -1.0, -1.0).floor().long().unbind(-1)
        height, width = self.white.shape
        inside = (shown.depth > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        covered = torch.zeros_like(inside)
        rows = torch.nonzero(inside)[:, 0]
        rows = rows[self.white.to(x.device)[row[rows], column[rows]]]
        eye = torch.as_tensor(self.camera.c2w[:, 3], dtype=x.dtype, device=x.device)
        offset = x[rows] - eye
        distance = offset.norm(dim=-1)
        hidden = surface.blocked(eye.expand_as(offset), offset / distance[:, None], distance - NEAR)
        covered[rows] = ~hidden
        return covered[:, None]


def read_stencils(paths: Sequence[Path], capture: Capture) -> list[Stencil]:
    """Masks by files; the name of a file, without its suffix, is that of the view that it is painted over.

    White counts, black does not; where there is transparency, what is transparent does not either.

    Raises:
        UserError: no such file, no view of the name, another shape than the view's, or nothing is white.
    """
    return [_read(path, capture) for path in paths]


def painted(stencils: Sequence[Stencil], surface: Surface) -> Limit:
    """Whether one of the masks covers a point of a surface."""

    def holds(x: Float[Tensor, "N 3"]) -> Bool[Tensor, "N 1"]:
        covered = [stencil.covers(x, surface) for stencil in stencils]
        return torch.stack(covered).any(0)

    return holds


def _read(path: Path, capture: Capture) -> Stencil:
    view = next((view for view in capture.views if view.name == path.stem), None)
    if view is None:
        remedy = f"name the file as the view it is painted over, as {capture.views[0].name}{path.suffix}"
        raise UserError(f"{path}: the capture has no view '{path.stem}'", remedy)
    header, camera = image_header(path), view.camera
    factor = header.width / camera.width
    if not math.isclose(header.height, camera.height * factor, abs_tol=1.0):
        raise UserError(
            f"{path}: a mask of {header.width}×{header.height} pixels over a view of "
            f"{camera.width}×{camera.height}",
            "paint it over the whole view, in any size of the same shape",
        )
    camera = resized(capture.normalisation.camera(camera), factor)
    file = read_image(path)
    value = torch.from_numpy(file.pixels).mean(-1)
    if file.alpha is not None:
        value = value * torch.from_numpy(file.alpha)
    white = torch.zeros(camera.height, camera.width, dtype=torch.bool)
    rows = min(camera.height, len(value))  # rounding may make one more or less
    white[:rows] = value[:rows] >= WHITE
    if not white.any():
        raise UserError(f"{path}: nothing in the mask is white", "paint white where the material changes")
    return Stencil(camera, white)
