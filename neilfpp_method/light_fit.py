"""Light from far away is solved for, not descended to.

With geometry and material fixed, what a surface sends is linear in the texels E of the environment map:

    L_o = k_d (D E + d) + F0 (F E + f) + (G E + g),   k_d = (1 − m) b,   F0 = 0.04 (1 − m) + b m

D, F, G carry the light of each texel to the viewer: cosine, visibility, solid angle, and the diffuse, the facing and the
grazing part of the BRDF; d, f, g are what the scene's own surfaces add. A few hundred steps on the map with these matrices
at hand cost less than as many steps of training, and find lamps that stochastic descent, through few and noisy samples of
every texel, spreads into a haze that the base colour then makes up for.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from neilfpp_method.config import InterReflectionConfig, LightFitConfig
from neilfpp_method.fields.environment import EnvironmentLight
from neilfpp_method.hosts.base import Host
from neilfpp_method.inter_reflection import scene_light
from neilfpp_method.shading.brdf import Lobe, diffuse_reflectance, normal_reflectance, specular_terms
from neilfpp_method.shading.color import apply_response
from neilfpp_method.shading.frame import dot
from neilfpp_method.structures import Indexable, Material

__all__ = ["Observed", "SurfaceMemory", "Transport", "fit_environment", "transport"]

PAIRS_AT_ONCE = 2**18
"""Pairs of a point and a texel that are traced together: what bounds the memory."""
SMOOTHED = 1e-2
"""Differences of log radiance below this count by their square, so that the total variation has a gradient everywhere."""
LEAST_RATE = 0.05
"""The last step's rate over the first's."""


@dataclass(frozen=True)
class Observed(Indexable):
    """Surface points and what an image holds of each: `pixel` in the capture's response, `wo` towards the camera."""

    position: Float[Tensor, "N 3"]
    normal: Float[Tensor, "N 3"]
    wo: Float[Tensor, "N 3"]
    pixel: Float[Tensor, "N 3"]


@dataclass(frozen=True)
class Transport:
    """How light leaves N points towards their viewers: the diffuse, the facing and the grazing part, in this order.

    `texels` is per unit of radiance of each of T texels, `scene` what the scene's own surfaces send through the points. A
    surface that is not `specular` has the diffuse part alone.
    """

    texels: Float[Tensor, "K N T"]
    scene: Float[Tensor, "K N 3"]
    specular: bool

    def outgoing(self, material: Material, radiance: Float[Tensor, "T 3"]) -> Float[Tensor, "N 3"]:
        """L_o under a map of this radiance; `material` brings the colours, its roughness is in the matrices."""
        diffuse, *reflected = self.texels @ radiance + self.scene
        color = diffuse_reflectance(material, self.specular) * diffuse
        if self.specular:
            facing, grazing = reflected
            color = color + normal_reflectance(material) * facing + grazing
        return color


# --------------------------------------------------------------------------------------------------------------- memory


class SurfaceMemory(nn.Module):
    """The points to fit to: a share of every step's, so that they come from all images. It is part of a checkpoint."""

    def __init__(self, config: LightFitConfig) -> None:
        super().__init__()
        self.every = config.every
        self.register_buffer("points", torch.zeros(config.points, 12))
        self.filled = 0
        self.next = 0
        self.age: int | None = None

    @property
    def due(self) -> bool:
        """Whether it is time to fit: at the first step that saw anything, and `every` steps after each fit."""
        return self.filled > 0 and (self.age is None or self.age >= self.every)

    @torch.no_grad()
    def remember(self, seen: Observed) -> None:
        """Keep some rows, in the place of the oldest; of the first step all of them."""
        capacity = len(self.points)
        share = capacity if self.filled == 0 else math.ceil(capacity / self.every)
        kept = torch.cat((seen.position, seen.normal, seen.wo, seen.pixel), -1)[:share].to(self.points.dtype)
        slots = torch.arange(self.next, self.next + len(kept), device=kept.device) % capacity
        self.points[slots] = kept
        self.next = (self.next + len(kept)) % capacity
        self.filled = min(self.filled + len(kept), capacity)
        if self.age is not None:
            self.age += 1

    def recall(self) -> Observed:
        """Everything that is remembered, for a fit that is done now."""
        self.age = 0
        return Observed(*self.points[: self.filled].split(3, -1))

    def get_extra_state(self) -> dict[str, int | None]:
        """Where the memory stands, for checkpoints."""
        return {"filled": self.filled, "next": self.next, "age": self.age}

    def set_extra_state(self, state: dict[str, int | None]) -> None:
        """The inverse of `get_extra_state`."""
        self.filled, self.next, self.age = state["filled"], state["next"], state["age"]


# ------------------------------------------------------------------------------------------------------------ transport


@torch.no_grad()
def transport(
    host: Host,
    seen: Observed,
    roughness: Float[Tensor, "N 1"],
    environment: EnvironmentLight,
    lobe: Lobe | None,
    config: InterReflectionConfig,
    hit_share: float,
) -> Transport:
    """Trace one direction per point and texel.

    Args:
        host: stands between the points and the map, and shines on them, unless inter-reflection is off.
        seen: surface points; unit normals and directions to the viewer.
        roughness: at the points.
        environment: whose texels are meant; its radiance plays no part.
        lobe: of the specular reflection; none for Lambertian surfaces.
        config, hit_share: how the host is traced.
    """
    rows = max(1, PAIRS_AT_ONCE // environment.log_radiance[0].numel())
    texels, scene = [], []
    for part, rough in zip(_split(seen, rows), roughness.split(rows), strict=True):
        drawn = environment.texel_directions(part.position)
        weight = dot(drawn.wi, part.normal).clamp_min(0) * drawn.solid_angle
        kernel = weight[None] / math.pi
        if lobe is not None:
            terms = specular_terms(rough, part.normal, part.wo, drawn.wi, lobe)
            kernel = torch.cat((kernel, torch.stack((weight * terms.facing, weight * terms.grazing))))
        added = kernel.new_zeros(*kernel.shape[:2], 3)
        if config.mode != "off":
            point, texel = torch.nonzero(weight > 0, as_tuple=True)
            met = scene_light(host, part.position[point], drawn.wi[point, texel][:, None], config, hit_share)
            added.index_add_(1, point, kernel[:, point, texel, None] * met.radiance[:, 0].to(kernel.dtype))
            kernel[:, point, texel] *= ~met.hit[:, 0]
        texels.append(kernel)
        scene.append(added)
    return Transport(torch.cat(texels, 1), torch.cat(scene, 1), specular=lobe is not None)


def _split(seen: Observed, rows: int) -> list[Observed]:
    return [seen[start : start + rows] for start in range(0, len(seen.position), rows)]


# ------------------------------------------------------------------------------------------------------------------ fit


def fit_environment(
    environment: EnvironmentLight,
    carried: Transport,
    material: Material,
    pixel: Float[Tensor, "N 3"],
    response: str,
    unit: float,
    config: LightFitConfig,
) -> None:
    """Set the map to the one under which the points look as the images show them, the smoothest where they do not say.

    Minimises the relative error, robustly, and the total variation of log radiance: lamps may be sharp, and what no point
    sees takes after its surroundings. Base colour and light share a scale, so a factor per channel on the base colour is
    free during the fit: the map need not make up for it.

    Args:
        environment: whose map is set; the search starts from what it is.
        carried: of `transport`.
        material: at the points; constants.
        pixel: what the images hold, in the response of the capture ("linear" or "srgb").
        unit: a pixel of typical brightness; errors are relative to the pixel and a share of this.
        config: weights and number of steps.
    """
    log_radiance = environment.log_radiance.clone().requires_grad_()
    log_gain = torch.zeros(3, device=log_radiance.device, requires_grad=True)
    rates = {"map": config.rate, "gain": config.rate / 5}
    optimizer = torch.optim.Adam(
        [{"params": [log_radiance], "name": "map"}, {"params": [log_gain], "name": "gain"}], betas=(0.9, 0.99)
    )
    scale = pixel + config.floor * unit
    with torch.enable_grad():
        for step in range(config.steps):
            for group in optimizer.param_groups:
                group["lr"] = rates[group["name"]] * LEAST_RATE ** (step / config.steps)
            tinted = (material.base_color * log_gain.exp()).clamp(0, 1)
            tinted = Material(tinted, material.roughness, material.metallic)
            radiance = log_radiance.exp().flatten(1).t()
            seen = apply_response(carried.outgoing(tinted, radiance), response)
            error = functional.smooth_l1_loss(seen / scale, pixel / scale, beta=config.outlier)
            loss = error + config.smoothness * total_variation(log_radiance)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
    if log_radiance.isfinite().all():
        environment.log_radiance.copy_(log_radiance.detach())


def total_variation(values: Float[Tensor, "C H W"]) -> Float[Tensor, ""]:
    """Σ |difference of neighbours| per texel, of a map that is closed in azimuth."""
    across = torch.cat((values, values[..., :1]), -1).diff(dim=-1)
    down = values.diff(dim=1)
    size = values[0].numel()
    return sum((step.square() + SMOOTHED**2).sqrt().sum() for step in (across, down)) / size
