"""A plain function as a host."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from neilfpp_method.errors import UserError
from neilfpp_method.hosts.outputs import check_tensors
from neilfpp_method.structures import RayBatch, SurfaceHits

__all__ = ["CallableHost", "RenderFunction", "function_hits"]

RenderFunction = Callable[[Tensor, Tensor], tuple[Tensor, Tensor, Tensor]]


class CallableHost:
    """Makes a host of a function (origins, directions) → (color, position, normal).

    A ray whose normal is shorter than ½ or not finite is a miss. This class is not an `nn.Module`, so that a
    function that is one is not registered as a submodule.
    """

    def __init__(self, function: RenderFunction) -> None:
        self.function = function
        self.name = getattr(function, "__qualname__", type(function).__name__)

    def render(self, rays: RayBatch) -> SurfaceHits:
        """Call the function; opacity and concentration are 1 for a hit and 0 for a miss.

        Raises:
            UserError: it does not return three tensors of the right shape on the device of the rays.
        """
        return function_hits(self.name, rays, self.function(rays.origins, rays.directions))


def function_hits(name: str, rays: RayBatch, answer: Any) -> SurfaceHits:
    """Convert (color, position, normal), each (N, 3), to hits.

    Args:
        name: name of the function, for error messages.
        rays: the rays that it was called with.
        answer: what it returned.

    Raises:
        UserError: these are not three tensors of the right shape on the device of the rays.
    """
    if not isinstance(answer, tuple | list) or len(answer) != 3:
        kind = f"{len(answer)} values" if isinstance(answer, tuple | list) else f"a {type(answer).__name__}"
        raise UserError(f"{name}: returns {kind}", "return color, position and normal, each (N, 3)")
    check_tensors(name, rays, dict(zip(("color", "position", "normal"), answer, strict=True)))
    color, position, normal = answer
    # The comparison is False for NaN.
    hit = normal.detach().square().sum(-1) > 0.25
    position = torch.where(hit[:, None], position, rays.origins.to(position.dtype))
    share = hit.to(color.dtype)
    return SurfaceHits(color, position, torch.where(hit[:, None], normal, 0.0), share, share)
