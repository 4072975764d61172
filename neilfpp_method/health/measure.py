"""Measure at some training pixels whether a model has a surface, and whether its material is plausible."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.hosts.base import HasPointCloud, HasSurfaceWidth, Host
from neilfpp_method.model import NeilfModel
from neilfpp_method.settings.types import NeilfConfig
from neilfpp_method.structures import Material, OrientedPoints, PixelBatch, SurfaceHits

__all__ = ["HeldBack", "SurfaceMeasurement", "measure_hits", "measure_surface"]

CLOUD_POINTS = 20_000
"""Maximum number of points of the cloud with which a surface is compared."""
OPAQUE = 0.5
"""Opacity above which a ray counts as opaque."""
AT_BOUND = 0.02
"""Distance from 0 or 1 within which a parameter of the material counts as at its bound."""


@dataclass(frozen=True)
class SurfaceMeasurement:
    """The result of a measurement; shares are between 0 and 1.

    Attributes:
        rays: number of rendered pixels on the object, according to the masks.
        opaque: share of these rays that are opaque.
        sharp: share of the opaque rays that hit a single surface, rather than fog or several surfaces.
        at_bound: share of the surface points whose base colour is within `AT_BOUND` of 0 or 1 in every
            channel; None without a material.
        off_cloud: median distance of the surface points from the point cloud that supervises the surface,
            scene units; None without a cloud or surface points.
        width: width of the soft layer that the surface is (β), scene units; None if the host has none.
        parked: share of the surface points at "roughness 0", "roughness 1" and "metallic 1"; empty without a
            specular material. A metallic of 0 is right for every object without metal.
    """

    rays: int
    opaque: float
    sharp: float
    at_bound: float | None
    off_cloud: float | None = None
    width: float | None = None
    parked: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class HeldBack:
    """What a training measures at the pixels that no step uses.

    Attributes:
        hits: what the host rendered there.
        physical: PSNR of the PBR rendering, dB; None before there is a material.
        constant: PSNR of the one colour that is closest to all these pixels, dB.
    """

    hits: SurfaceHits
    physical: float | None
    constant: float


@torch.no_grad()
def measure_surface(model: NeilfModel, pixels: PixelBatch, with_material: bool) -> SurfaceMeasurement:
    """Render training pixels and measure surface and material.

    Args:
        model: a model on any host; its training mode is left unchanged.
        pixels: training pixels on the device of the model; those off the object are ignored.
        with_material: whether there is a material to measure.
    """
    with model.evaluating():
        hits = model.host.render(pixels[torch.nonzero(pixels.mask > 0.5)[:, 0]].rays)
        return measure_hits(model, hits, with_material)


@torch.no_grad()
def measure_hits(model: NeilfModel, hits: SurfaceHits, with_material: bool) -> SurfaceMeasurement:
    """The same as `measure_surface`, for pixels on the object that the host has already rendered."""
    opaque = hits.opacity > OPAQUE
    sharp = opaque & hits.is_hit(model.config.shading.hit_share)
    at_bound, parked = None, {}
    if with_material and sharp.any():
        material = model.materials(hits.position[sharp])
        at_bound, parked = _share_at_bound(material), _shares_parked(material, model.config)
    off_cloud = _off_cloud(model.host, hits.position[sharp])
    width = float(model.host.surface_width()) if isinstance(model.host, HasSurfaceWidth) else None
    return SurfaceMeasurement(
        len(hits), _share(opaque), _share(sharp[opaque]), at_bound, off_cloud, width, parked
    )


def _share(flags: torch.Tensor) -> float:
    return flags.float().mean().item() if len(flags) else 0.0


def _off_cloud(host: Host, position: Float[Tensor, "N 3"]) -> float | None:
    cloud = host.points if isinstance(host, HasPointCloud) else None
    # Hosts of others may have points of another kind.
    if not isinstance(cloud, OrientedPoints) or not len(cloud.position) or not len(position):
        return None
    drawn = cloud.position[:: -(-len(cloud.position) // CLOUD_POINTS)]
    return torch.cdist(position, drawn).amin(1).median().item()


def _share_at_bound(material: Material) -> float:
    color = material.base_color
    return _share(((color < AT_BOUND) | (color > 1 - AT_BOUND)).all(-1))


def _shares_parked(material: Material, config: NeilfConfig) -> dict[str, float]:
    if not config.shading.specular:
        return {}
    flags = {
        "roughness 0": material.roughness < AT_BOUND,
        "roughness 1": material.roughness > 1 - AT_BOUND,
        "metallic 1": material.metallic > 1 - AT_BOUND,
    }
    return {name: _share(at_bound) for name, at_bound in flags.items()}
