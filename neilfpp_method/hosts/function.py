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
    """A function (origins, directions) → (color, position, normal) as a host.

    A ray misses where its normal is shorter than one half or not finite. This is no `nn.Module`: a function
    that is one stays where it belongs.
    """

    def __init__(self, function: RenderFunction) -> None:
        self.function = function
        self.name = getattr(function, "__qualname__", type(function).__name__)

    def render(self, rays: RayBatch) -> SurfaceHits:
        """The function's answer; opacity and concentration are 1 for a hit, 0 for a miss.

        Raises:
            UserError: it does not return three tensors of the right shape on the device of the rays.
        """
        return function_hits(self.name, rays, self.function(rays.origins, rays.directions))


def function_hits(name: str, rays: RayBatch, answer: Any) -> SurfaceHits:
    """The hits of rays from (color, position, normal), each (N, 3).

    Args:
        name: of the function, for errors.
        rays: what it was asked.
        answer: what it returned.

    Raises:
        UserError: these are not three tensors of the right shape on the device of the rays.
    """
    if not isinstance(answer, tuple | list) or len(answer) != 3:
        kind = f"{len(answer)} values" if isinstance(answer, tuple | list) else f"a {type(answer).__name__}"
        raise UserError(f"{name}: returns {kind}", "return color, position and normal, each (N, 3)")
    check_tensors(name, rays, dict(zip(("color", "position", "normal"), answer, strict=True)))
    color, position, normal = answer
    hit = normal.detach().square().sum(-1) > 0.25  # not so for NaN
    position = torch.where(hit[:, None], position, rays.origins.to(position.dtype))
    share = hit.to(color.dtype)
    return SurfaceHits(color, position, torch.where(hit[:, None], normal, 0.0), share, share)
