"""A host that somebody else wrote, as the method asks it: never with zero rays, always in the precision of
the rays, and with a proxy in its place where it traces no rays.
"""

from __future__ import annotations

import logging
from collections.abc import Collection
from dataclasses import fields
from typing import Any

import torch
from torch import Tensor, nn

from neilfpp_method.data.views import Camera
from neilfpp_method.errors import UserError
from neilfpp_method.hosts.answers import as_hits, in_precision, no_hits
from neilfpp_method.hosts.base import ImageHost, KnowsRadiance, LightsItself, RegularisedHits
from neilfpp_method.hosts.image import rays_like
from neilfpp_method.hosts.outputs import check_tensors, host_name
from neilfpp_method.hosts.proxy import SurfaceProxy
from neilfpp_method.settings.types import NeilfConfig
from neilfpp_method.structures import PixelBatch, RayBatch, SurfaceHits
from neilfpp_method.volume.distance_grid import GRID_RESOLUTION

__all__ = ["ForeignHost", "answers_secondary_rays", "proxy_for"]

PASSED_ON = (
    "may_meet",
    "surface_width",
    "smooth_normals",
    "parameter_groups",
    "sdf",
    "stages",
    "scene_light",
)
"""Optional capabilities of `hosts.base` that are the host's own."""
COARSE = (torch.float16, torch.bfloat16)

log = logging.getLogger(__name__)


def answers_secondary_rays(host: object) -> bool:
    """Whether a host renders rays that leave a surface; not if it draws whole images, or declares no."""
    return hasattr(host, "render") and bool(getattr(host, "answers_secondary_rays", True))


def proxy_for(host: object, config: NeilfConfig) -> SurfaceProxy | None:
    """What traces rays between surfaces for a host that does not, or not cheaply, where the settings ask for
    them; none: nobody needs to.
    """
    settings = config.inter_reflection
    asked = settings.mode != "off" and not answers_secondary_rays(host)
    if isinstance(host, LightsItself) or not (asked or settings.mode == "hard"):
        return None
    radiance = host.radiance if isinstance(host, KnowsRadiance) else None
    return SurfaceProxy(config.volume.radius, GRID_RESOLUTION, config.shading.hit_share, radiance)


class ForeignHost(nn.Module):
    """The host contract around a host.

    Args:
        host: a `Host` or an `ImageHost`.
        borrowed: it belongs to another trainer, and is none of this module's business.
        proxy: answers the rays between surfaces; none: the host renders them.
    """

    def __init__(self, host: object, borrowed: bool, proxy: SurfaceProxy | None = None) -> None:
        super().__init__()
        if borrowed or not isinstance(host, nn.Module):
            object.__setattr__(self, "inner", host)  # past nn.Module, which would take it in
        else:
            self.inner = host
        object.__setattr__(self, "proxy", proxy)  # belongs to whoever attaches
        self.name = host_name(host)
        self.coarse_said = False
        for capability in PASSED_ON:
            if hasattr(host, capability):
                object.__setattr__(self, capability, getattr(host, capability))
        if proxy is not None:
            object.__setattr__(self, "scene_light", proxy.scene_light)
        if hasattr(host, "render_regularised"):
            object.__setattr__(self, "render_regularised", self._render_regularised)

    def render(self, rays: RayBatch) -> SurfaceHits:
        """The host's hits; those of the proxy where the host answers no rays of ours.

        Raises:
            UserError: what came back breaks the contract.
        """
        if len(rays) == 0:
            return no_hits(rays)
        if self.proxy is not None and not answers_secondary_rays(self.inner):
            return self.proxy.render(rays)
        if not hasattr(self.inner, "render"):
            return self.camera_hits(rays)
        return self._usable(rays, self.inner.render(rays))

    def camera_hits(self, rays: RayBatch) -> SurfaceHits:
        """The host's own hits of camera rays.

        Raises:
            UserError: it draws whole images, and nobody has handed them in.
        """
        if not hasattr(self.inner, "render"):
            raise UserError(
                f"{self.name} draws whole images, not rays",
                "hand in what it has drawn: losses(batch, step, hits) and maps(rays, hits), see "
                "docs/hosts.md",
            )
        return no_hits(rays) if len(rays) == 0 else self._usable(rays, self.inner.render(rays))

    def image_hits(self, camera: Camera, like: Tensor) -> tuple[RayBatch, SurfaceHits]:
        """The rays of all pixels of a camera, and the host's hits of them.

        Raises:
            UserError: it has no `render_image`.
        """
        if not isinstance(self.inner, ImageHost):
            raise UserError(
                f"{self.name} has no render_image(camera)", "give rays: data.views.camera_rays(camera)"
            )
        rays = rays_like(camera, like)
        return rays, self.read(rays, self.inner.render_image(camera))

    def read(self, rays: RayBatch, rendered: object) -> SurfaceHits:
        """What the host has rendered of these rays, in any form that `hosts.answers` reads.

        Raises:
            UserError: it cannot be read.
        """
        return self._precise(rays, as_hits(self.inner, rays, rendered))

    def show_proxy(self, rays: RayBatch, hits: SurfaceHits) -> None:
        """Let the proxy learn from a training step's camera rays; before the first it looks around."""
        if self.proxy is None or len(rays) == 0:
            return
        if self.proxy.steps == 0 and answers_secondary_rays(self.inner):
            self.proxy.look_around(self.render, rays, hits)
        self.proxy.observe(rays, hits)

    def _render_regularised(self, batch: PixelBatch, names: Collection[str]) -> RegularisedHits:
        if len(batch) == 0:
            return RegularisedHits(no_hits(batch.rays), {})
        rendered = self.inner.render_regularised(batch, names)
        return RegularisedHits(self._usable(batch.rays, rendered.hits), rendered.terms)

    def _usable(self, rays: RayBatch, hits: Any) -> SurfaceHits:
        check_tensors(self.name, rays, {f.name: getattr(hits, f.name, None) for f in fields(SurfaceHits)})
        return self._precise(rays, hits)

    def _precise(self, rays: RayBatch, hits: SurfaceHits) -> SurfaceHits:
        if hits.position.dtype in COARSE and not self.coarse_said:
            self.coarse_said = True
            digits = torch.finfo(hits.position.dtype).eps
            log.warning(
                "%s: its position is %s, which knows places to %.0e; leave half precision for the position: "
                "return float32",
                self.name,
                hits.position.dtype,
                digits,
            )
        return in_precision(hits, rays.origins.dtype)
