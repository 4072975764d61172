"""Smooth normals for shading, except across edges.

A learned distance field has ripples of the size of its grid cells. A highlight moves by twice the angle of
the normal, so a ripple of three degrees hides what distinguishes metal from paint. So a linear function of
the tangent plane is fitted robustly to the normals around a point: the normals may turn evenly, as on a ball,
and those beyond an edge get little weight (Öztireli, Guennebaud and Gross 2009, "Feature preserving point set
surfaces based on non-linear kernel regression").
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from neilfpp_method.shading.frame import local_frame, safe_normalize

__all__ = ["NEIGHBORS", "smooth_normals"]

RINGS = ((6, 1 / 3), (10, 2 / 3), (16, 1.0))
"""Number of neighbours on each ring around the point, and the ring's radius relative to the outermost."""
NEIGHBORS = sum(count for count, _ in RINGS)
"""Number of points at which normals are evaluated, per shaded point."""
RESIDUAL_SCALE = 0.2
"""Residual of a unit normal at which its weight is 1/√e; it corresponds to 11.5°."""
ITERATIONS = 4
"""Number of fits of iteratively reweighted least squares."""
RIDGE = 1e-2
"""Ridge penalty, relative to the weight of one neighbour, for slopes that no neighbour determines."""


@torch.no_grad()
def smooth_normals(
    gradient: Callable[[Float[Tensor, "P 3"]], Float[Tensor, "P 3"]],
    position: Float[Tensor, "N 3"],
    normal: Float[Tensor, "N 3"],
    radius: float,
) -> Float[Tensor, "N 3"]:
    """Smoothed unit normals at surface points.

    Args:
        gradient: gradient of the signed distance; called with `NEIGHBORS` points around each point.
        position: points on the surface, scene frame.
        normal: their unit normals, not smoothed.
        radius: radius of the neighbourhood, scene units. Relief that is finer than this and flatter than
            about 10° is lost.
    """
    # Half precision is too coarse for the fit of a plane to normals.
    with torch.autocast(position.device.type, enabled=False):
        return _smoothed(gradient, position, normal, radius)


def _smoothed(
    gradient: Callable[[Float[Tensor, "P 3"]], Float[Tensor, "P 3"]],
    position: Float[Tensor, "N 3"],
    normal: Float[Tensor, "N 3"],
    radius: float,
) -> Float[Tensor, "N 3"]:
    ring = _rings(position)
    around = position[:, None] + radius * (ring @ local_frame(normal)[:, :2])
    normals = torch.cat((normal[:, None], safe_normalize(gradient(around.flatten(0, 1))).view_as(around)), 1)
    # Regressors of the linear function: 1 and the offset in units of the radius. The point itself is first.
    design = functional.pad(torch.cat((torch.zeros_like(ring[:1]), ring)), (1, 0), value=1.0)
    ridge = RIDGE * torch.eye(3).to(ring)
    residual = normals - normal[:, None]
    for _ in range(ITERATIONS):
        weighted = design * torch.exp(-residual.square().sum(-1, keepdim=True) / (2 * RESIDUAL_SCALE**2))
        # The ridge makes the matrix regular. `solve` would synchronise with the device to check that.
        coefficients = torch.linalg.solve_ex(weighted.mT @ design + ridge, weighted.mT @ normals).result
        residual = normals - design @ coefficients
    return safe_normalize(coefficients[:, 0])


def _rings(like: Tensor) -> Float[Tensor, "K 2"]:
    """Offsets in the tangent plane for a radius of 1; each ring is rotated relative to the previous one."""
    angles = [
        (torch.arange(count) + 0.5 * number) * (2 * math.pi / count)
        for number, (count, _) in enumerate(RINGS)
    ]
    shares = torch.cat([torch.full((count,), share) for count, share in RINGS])
    angle = torch.cat(angles)
    return (shares * torch.stack((angle.cos(), angle.sin()))).t().to(like)
