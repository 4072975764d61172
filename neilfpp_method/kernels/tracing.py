"""Sphere tracing through a sampled distance field on the CPU, by compiled loops."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from neilfpp_method.kernels import compiled
from neilfpp_method.kernels.threads import for_each, shares

__all__ = ["sphere_trace"]

MIN_RAYS_PER_THREAD = 2048
"""Rays that are worth waking a thread for."""


@torch.compiler.disable  # a compiler cannot look into the loops, and need not
def sphere_trace(
    grid: Float[Tensor, "R R R"],
    radius: float,
    origins: Float[Tensor, "P 3"],
    directions: Float[Tensor, "P 3"],
    least: float,
    steps: int,
    distance: Float[Tensor, " P"],
    hit: Bool[Tensor, " P"],
) -> None:
    """Write how far each ray goes, and whether it comes closer to a surface than `least`, in `steps` steps.

    A step is as long as the distance allows, and no shorter than `least`. The grid has the distances at the
    vertices z, y, x of the cube [−radius, radius]³, beyond which a ray ends. All are of one float type.
    """
    vertices, start, towards = (tensor.contiguous().numpy() for tensor in (grid, origins, directions))
    written, least = (distance.numpy(), hit.numpy()), vertices.dtype.type(least)

    def trace(first: int, last: int) -> None:
        compiled.sphere_trace(vertices, radius, start, towards, least, steps, *written, first, last)

    for_each(trace, shares(len(origins), MIN_RAYS_PER_THREAD))
