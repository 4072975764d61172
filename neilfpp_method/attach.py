"""`attach_neilf`: material and light on top of somebody else's geometry and radiance."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from neilfpp_method.config import NeilfConfig, preset
from neilfpp_method.hosts.base import Host
from neilfpp_method.model import NeilfModel, SceneFacts
from neilfpp_method.structures import RayBatch, SurfaceHits

__all__ = ["CallableHost", "attach_neilf"]

RenderFunction = Callable[[Tensor, Tensor], tuple[Tensor, Tensor, Tensor]]


class CallableHost(nn.Module):
    """A function (origins, directions) → (color, position, normal) as a host.

    A ray misses where its normal is zero or not finite.
    """

    def __init__(self, function: RenderFunction) -> None:
        super().__init__()
        self.function = function

    def render(self, rays: RayBatch) -> SurfaceHits:
        """The function's answer; opacity and concentration are 1 for a hit, 0 for a miss."""
        color, position, normal = self.function(rays.origins, rays.directions)
        hit = (normal.isfinite().all(-1) & (normal.detach().square().sum(-1) > 0.25)).to(color.dtype)
        normal = torch.where(hit[:, None] > 0, normal, torch.zeros_like(normal))
        position = torch.where(hit[:, None] > 0, position, rays.origins)
        return SurfaceHits(color, position, normal, hit, hit)


def attach_neilf(
    host: Host | RenderFunction,
    config: NeilfConfig | None = None,
    *,
    response: str = "linear",
    median_radiance: float = 0.5,
    radiance_scale: float = 3.0,
) -> NeilfModel:
    """Put the material field, the light field and their losses on top of a host.

    In a training loop of your own: `terms = neilf.losses(batch, Stage.MATERIAL_INIT)`, weighed by `schedule.weigh`.

    Args:
        host: an object with `render(rays) -> SurfaceHits`, or a function (origins, directions) → (color, position, normal),
            in a frame where the object lies in the unit sphere.
        config: the settings; none: the preset `fast`.
        response: "linear" for HDR pixels, "srgb" for LDR ones.
        median_radiance: median linear luminance of the object in the images; sets the light's first guess.
        radiance_scale: the range of the host's radiance; L_vol is divided by it.
    """
    adapted = host if isinstance(host, Host) else CallableHost(host)
    facts = SceneFacts(response, median_radiance, radiance_scale, background="constant")
    return NeilfModel(adapted, config or preset("fast"), facts)
