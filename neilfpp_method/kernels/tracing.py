"""Sphere tracing through a sampled distance field on the CPU, by compiled loops."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from neilfpp_method.kernels import compiled
from neilfpp_method.kernels.threads import for_each, shares

__all__ = ["sphere_trace"]

MIN_RAYS_PER_THREAD = 2048
"""Minimum work of a thread, in rays; below it, starting the thread costs more than it saves."""


# `torch.compile` cannot trace the loops.
@torch.compiler.disable
def sphere_trace(
    grid: Float[Tensor, "R R R"],
    radius: float,
    origins: Float[Tensor, "P 3"],
    directions: Float[Tensor, "P 3"],
    *,
    hit_distance: float,
    leaves_surface: bool,
    steps: int,
    distance: Float[Tensor, " P"],
    hit: Bool[Tensor, " P"],
) -> None:
    """Trace rays in a sampled distance field until they come closer to a surface than `hit_distance`.

    Each step has the length of the distance at its start, but at least `hit_distance`. A ray also ends after
    `steps` steps or when it leaves the cube [−radius, radius]³. All floating-point tensors have the same
    type.

    A ray that leaves a surface starts closer to it than `hit_distance`, or below it. Until it is clear of the
    surface, it hits only where it is deeper than its start by `hit_distance`.

    Args:
        grid: distances at the vertices z, y, x of the cube.
        radius: half the edge of the cube.
        origins: origins of the rays.
        directions: unit directions of the rays.
        hit_distance: distance below which a surface counts as hit.
        leaves_surface: whether the rays start at a surface, which they must not hit.
        steps: maximum number of steps.
        distance: receives the length of each ray.
        hit: receives whether each ray has hit a surface.
    """
    vertices, start, towards = (tensor.contiguous().numpy() for tensor in (grid, origins, directions))
    written, closest = (distance.numpy(), hit.numpy()), vertices.dtype.type(hit_distance)

    def trace(first: int, last: int) -> None:
        compiled.sphere_trace(
            vertices, radius, start, towards, closest, leaves_surface, steps, *written, first, last
        )

    for_each(trace, shares(len(origins), MIN_RAYS_PER_THREAD))
