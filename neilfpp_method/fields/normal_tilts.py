"""A field of small tilts that corrects the normals of a recovered surface for shading.

The normals of a surface that was recovered from images are off by a few degrees over areas much larger than
a pixel. A highlight moves by twice that angle, and without correction B compensates for it with a wrong
material. A coarse field can correct the normals, but it is too coarse to imitate texture by shading.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from neilfpp_method.shading.frame import safe_normalize

__all__ = ["NormalTilts", "tilted"]

VERTICES = 24
"""Vertices of the grid along each edge of the cube [−1, 1]³, which contains the object."""
UNIT = 0.1
"""Radians per unit of a parameter. At the learning rate of B in `fast`, 0.01, a step of Adam changes each
component of the tilt by about 0.06°.
"""
MAX_GRADIENT = 3.0
"""Length of the gradient of a point, relative to the median of the batch, to which longer ones are scaled. A
few samples of sharp lobes would otherwise determine the step.
"""


class NormalTilts(nn.Module):
    """Tilts by trilinear interpolation of a grid of vectors; 0 at first, and outside the cube.

    Example:
        >>> tilts = NormalTilts()
        >>> tilts(torch.zeros(1, 3))
        tensor([[0., 0., 0.]], grad_fn=<MulBackward0>)
    """

    def __init__(self) -> None:
        super().__init__()
        self.grid = nn.Parameter(torch.zeros(1, 3, VERTICES, VERTICES, VERTICES))

    def forward(self, x: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
        """Tilts at points of the scene frame, in radians, for `tilted`; no gradient flows into the points."""
        points = x.detach().to(self.grid.dtype).view(1, -1, 1, 1, 3)
        values = functional.grid_sample(self.grid, points, align_corners=True)
        tilt = UNIT * values[0, :, :, 0, 0].t()
        if tilt.requires_grad:
            tilt.register_hook(_limit_outliers)
        return tilt


def tilted(normal: Float[Tensor, "N 3"], tilt: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
    """Unit normals, turned in the direction of the part of `tilt` in the tangent plane.

    Args:
        normal: unit normals.
        tilt: vector whose tangential part has the tangent of the angle as its length.
    """
    tangential = tilt - (tilt * normal).sum(-1, keepdim=True) * normal
    return safe_normalize(normal + tangential)


def _limit_outliers(gradient: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
    """Scale gradients of points that are much longer than the median down to `MAX_GRADIENT` medians."""
    length = gradient.norm(dim=-1, keepdim=True)
    if not len(length):
        return gradient
    limit = MAX_GRADIENT * length.median()
    return gradient * (limit / length.clamp_min(torch.finfo(length.dtype).tiny)).clamp_max(1.0)
