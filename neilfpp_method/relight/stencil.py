"""Masks painted over a view, which limit edits of the material to the surface behind white pixels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from neilfpp_method.data.cameras.camera import Camera
from neilfpp_method.data.cameras.projection import pixel_index, project
from neilfpp_method.data.capture import Capture
from neilfpp_method.data.files.images import image_header, read_image
from neilfpp_method.errors import UserError
from neilfpp_method.relight.cameras import MAX_SIDE, resized
from neilfpp_method.relight.edits import Limit
from neilfpp_method.relight.surface import Surface

__all__ = ["Stencil", "masked_limit", "read_stencils"]

MAX_DEPTH_BEHIND = 2e-3
"""A point is visible if it is at most this distance behind the first hit of its ray, scene units."""
MIN_WHITE = 0.5
"""Value from which a pixel counts as white."""


@dataclass(frozen=True)
class Stencil:
    """A camera in the scene frame with the size of a mask, and the white pixels of the mask."""

    camera: Camera
    white: Bool[Tensor, "H W"]

    def covers(self, x: Float[Tensor, "N 3"], surface: Surface) -> Bool[Tensor, "N 1"]:
        """Whether the camera sees points through a white pixel, without occlusion by the surface."""
        index = pixel_index(project(self.camera, x), self.camera)
        covered = (index >= 0) & self.white.to(x.device).flatten()[index]
        rows = torch.nonzero(covered)[:, 0]
        eye = torch.as_tensor(self.camera.c2w[:, 3], dtype=x.dtype, device=x.device)
        offset = x[rows] - eye
        distance = offset.norm(dim=-1)
        occluded = surface.blocked(
            eye.expand_as(offset), offset / distance[:, None], distance - MAX_DEPTH_BEHIND
        )
        covered[rows] = ~occluded
        return covered[:, None]


def read_stencils(paths: Sequence[Path], capture: Capture) -> list[Stencil]:
    """Read masks. The name of a file, without its suffix, is the name of the view that it was painted over.

    Edits apply at white pixels, but not at transparent ones.

    Raises:
        UserError: there is no such file or view, the aspect ratio differs from the view's, a side has more
            than 8192 pixels, or no pixel is white.
    """
    return [_read(path, capture) for path in paths]


def masked_limit(stencils: Sequence[Stencil], surface: Surface) -> Limit:
    """Return a limit that contains the points of a surface that at least one of the masks covers."""

    def limit(x: Float[Tensor, "N 3"]) -> Bool[Tensor, "N 1"]:
        covered = [stencil.covers(x, surface) for stencil in stencils]
        return torch.stack(covered).any(0)

    return limit


def _read(path: Path, capture: Capture) -> Stencil:
    view = next((view for view in capture.views if view.name == path.stem), None)
    if view is None:
        remedy = f"name the file as the view, for example {capture.views[0].name}{path.suffix}"
        raise UserError(f"{path}: the capture has no view '{path.stem}'", remedy)
    header, camera = image_header(path), view.camera
    factor = header.width / camera.width
    if not math.isclose(header.height, camera.height * factor, abs_tol=1.0):
        raise UserError(
            f"{path}: the mask has {header.width}×{header.height} pixels, but the view has "
            f"{camera.width}×{camera.height}",
            "paint it over the whole view, in any size with the same aspect ratio",
        )
    if max(header.width, header.height) > MAX_SIDE:
        raise UserError(
            f"{path}: the mask has {header.width}×{header.height} pixels",
            f"reduce it to at most {MAX_SIDE} pixels per side",
        )
    camera = resized(capture.normalization.camera(camera), factor)
    file = read_image(path)
    value = torch.from_numpy(file.pixels).mean(-1)
    if file.alpha is not None:
        value = value * torch.from_numpy(file.alpha)
    white = torch.zeros(camera.height, camera.width, dtype=torch.bool)
    # Due to rounding, the heights of camera and mask may differ by one row.
    rows = min(camera.height, len(value))
    white[:rows] = value[:rows] >= MIN_WHITE
    if not white.any():
        raise UserError(
            f"{path}: no pixel of the mask is white", "paint the pixels white at which the material changes"
        )
    return Stencil(camera, white)
