"""Adapter for hosts of other projects.

It never calls a host with zero rays, converts its outputs to the precision of the rays, and uses a proxy for
rays that the host cannot trace.
"""

from __future__ import annotations

import logging
from collections.abc import Collection

import torch
from torch import Tensor, nn

from neilfpp_method.data.cameras.camera import Camera
from neilfpp_method.errors import UserError
from neilfpp_method.hosts.base import HasRadiance, ImageHost, RegularizedHits, TracesLight
from neilfpp_method.hosts.conversion import as_hits, given_depth, no_hits
from neilfpp_method.hosts.function import CallableHost
from neilfpp_method.hosts.outputs import host_name
from neilfpp_method.hosts.proxy import SurfaceProxy
from neilfpp_method.settings.types import NeilfConfig
from neilfpp_method.structures import PixelBatch, RayBatch, SurfaceHits
from neilfpp_method.volume.distance_grid import GRID_RESOLUTION

__all__ = ["ForeignHost", "answers_secondary_rays", "proxy_for"]

PASSED_ON = (
    "may_hit",
    "surface_width",
    "smooth_normals",
    "parameter_groups",
    "sdf",
    "stages",
    "scene_light",
)
"""Optional methods of `hosts.base` that are forwarded to the host unchanged."""
COARSE_TYPES = (torch.float16, torch.bfloat16)
"""Types that are too coarse for positions."""

log = logging.getLogger(__name__)


def answers_secondary_rays(host: object) -> bool:
    """Whether a host renders rays that start at a surface: not if it draws images, or declares otherwise."""
    return hasattr(host, "render") and bool(getattr(host, "answers_secondary_rays", True))


def proxy_for(host: object, config: NeilfConfig) -> SurfaceProxy | None:
    """Make a proxy if the settings need rays between surfaces that the host cannot trace, or not cheaply.

    Returns None if no proxy is needed.
    """
    mode = config.light.inter_reflection
    cannot_trace = mode != "off" and not answers_secondary_rays(host)
    if isinstance(host, TracesLight) or not (cannot_trace or mode == "hard"):
        return None
    radiance = host.radiance if isinstance(host, HasRadiance) else None
    return SurfaceProxy(config.background.radius, GRID_RESOLUTION, config.shading.hit_share, radiance)


class ForeignHost(nn.Module):
    """A host of another project behind the full host contract.

    Args:
        host: a `Host` or an `ImageHost`.
        borrowed: whether the host belongs to another trainer, so that it must not become a submodule.
        proxy: traces rays between surfaces; if None, the host renders them.
    """

    def __init__(self, host: object, borrowed: bool, proxy: SurfaceProxy | None = None) -> None:
        super().__init__()
        if borrowed or not isinstance(host, nn.Module):
            # Bypass nn.Module, which would register the host as a submodule.
            object.__setattr__(self, "inner", host)
        else:
            self.inner = host
        # The proxy is a submodule of `AttachedNeilf`, not of this module.
        object.__setattr__(self, "proxy", proxy)
        self.name = host_name(host)
        self.warned_of_precision = False
        for capability in PASSED_ON:
            if hasattr(host, capability):
                object.__setattr__(self, capability, getattr(host, capability))
        if proxy is not None:
            object.__setattr__(self, "scene_light", proxy.scene_light)
        if hasattr(host, "render_regularized"):
            object.__setattr__(self, "render_regularized", self._render_regularized)

    def render(self, rays: RayBatch) -> SurfaceHits:
        """Hits by the host, or by the proxy if the host cannot render rays that start at a surface.

        Raises:
            UserError: the output breaks the contract.
        """
        if len(rays) == 0:
            return no_hits(rays)
        if self.proxy is not None and not answers_secondary_rays(self.inner):
            return self.proxy.render(rays)
        if not hasattr(self.inner, "render"):
            return self.camera_hits(rays)
        return self.read(rays, self._call(rays))

    def camera_hits(self, rays: RayBatch) -> SurfaceHits:
        """Hits of camera rays by the host itself.

        Raises:
            UserError: the host draws whole images, so the caller has to pass their hits.
        """
        if not hasattr(self.inner, "render"):
            raise UserError(
                f"{self.name} draws whole images, not rays",
                "pass its hits: losses(batch, step, hits) and maps(rays, hits), see docs/hosts.md",
            )
        return no_hits(rays) if len(rays) == 0 else self.read(rays, self._call(rays))

    def image_hits(self, camera: Camera, rays: RayBatch) -> SurfaceHits:
        """The hits of all pixels of a camera, whose rays are given, by a host that draws whole images.

        Raises:
            UserError: the host has no `render_image`.
        """
        if not isinstance(self.inner, ImageHost):
            raise UserError(
                f"{self.name} has no render_image(camera)", "give rays: data.projection.camera_rays(camera)"
            )
        return self.read(rays, self.inner.render_image(camera))

    def read(self, rays: RayBatch, rendered: object) -> SurfaceHits:
        """Convert what the host rendered for these rays, in any form that `hosts.conversion` reads.

        Raises:
            UserError: it cannot be converted.
        """
        return self._precise(rays, as_hits(self.inner, rays, rendered), given_depth(rendered))

    def update_proxy(self, rays: RayBatch, hits: SurfaceHits) -> None:
        """Add the camera rays of a training step to the proxy; the first call also explores the surface."""
        if self.proxy is None or len(rays) == 0:
            return
        if self.proxy.steps == 0 and answers_secondary_rays(self.inner):
            self.proxy.explore(self.render, rays, hits)
        self.proxy.observe(rays, hits)

    def _render_regularized(self, batch: PixelBatch, names: Collection[str]) -> RegularizedHits:
        if len(batch) == 0:
            return RegularizedHits(no_hits(batch.rays), {})
        rendered = self.inner.render_regularized(batch, names)
        return RegularizedHits(self.read(batch.rays, rendered.hits), rendered.terms)

    def _call(self, rays: RayBatch) -> object:
        """What the host returns; that of a function is not converted yet, so that its depths are seen."""
        return self.inner.call(rays) if isinstance(self.inner, CallableHost) else self.inner.render(rays)

    def _precise(self, rays: RayBatch, hits: SurfaceHits, depth: Tensor | None) -> SurfaceHits:
        for name, value in (("position", hits.position), ("depth", depth)):
            if value is not None and value.dtype in COARSE_TYPES and not self.warned_of_precision:
                self.warned_of_precision = True
                log.warning(
                    "%s: its %s is %s, whose relative precision is %.0e; return %ss in float32",
                    self.name,
                    name,
                    value.dtype,
                    torch.finfo(value.dtype).eps,
                    name,
                )
        return hits.map(lambda t: t.to(rays.origins.dtype))
