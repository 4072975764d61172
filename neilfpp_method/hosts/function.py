"""A plain function as a host."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from neilfpp_method.hosts.conversion import Rendered, as_hits
from neilfpp_method.structures import RayBatch, SurfaceHits

__all__ = ["CallableHost", "RenderFunction"]

RenderFunction = Callable[[Tensor, Tensor], Rendered]


class CallableHost:
    """Makes a host of a function (origins, directions) → (color, position, normal).

    A ray whose normal is shorter than ½ or not finite is a miss. The function may return a dictionary or
    `SurfaceHits` instead, which is read as `hosts.conversion` says. This class is not an `nn.Module`, so that
    a function that is one is not registered as a submodule.
    """

    def __init__(self, function: RenderFunction) -> None:
        self.function = function
        self.name = getattr(function, "__qualname__", type(function).__name__)

    def render(self, rays: RayBatch) -> SurfaceHits:
        """Call the function. If it returns a tuple, opacity and concentration are 1 for a hit, 0 for a miss.

        Raises:
            UserError: it does not return tensors of the right shape on the device of the rays.
        """
        return as_hits(self, rays, self.call(rays))

    def call(self, rays: RayBatch) -> object:
        """What the function returns for these rays, unchanged and unchecked."""
        return self.function(rays.origins, rays.directions)
