"""Light and materials that explain some places together: an environment map, and at each place one base
colour, one roughness of a grid, and one metallic of a grid.

With few places everything is small: transport is a matrix for each roughness, the best material under a light
is found by trying all pairs of roughness and metallic, the best light under the materials by descent, and the
two take turns.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from neilfpp_method.effects.places import Places
from neilfpp_method.fields.environment import EnvironmentLight
from neilfpp_method.lighting.objective import FLOOR, OUTLIER, total_variation
from neilfpp_method.lighting.transport import Transport, from_texels_at
from neilfpp_method.shading.brdf import Lobe
from neilfpp_method.structures import SceneTracer

__all__ = ["PlaceFit", "any_map", "fit_places", "place_errors", "place_transport"]

ROUGHNESSES = (0.08, 0.14, 0.2, 0.28, 0.36, 0.45, 0.55, 0.66, 0.8, 1.0)
"""Of the grid; the lobe's width changes by about a half from one to the next."""
METALLICS = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)
"""Of the grid."""
ROWS = 32
"""Of the map: texels of 6°, in which lobes of roughness 0.3 fit."""
ROUNDS = 6
"""Turns of material and light."""
FIRST_STEPS, STEPS = 100, 40
"""Of the light in the first turn and in each later one."""
RATE, GAIN_RATE = 0.1, 0.03
"""Of log radiance, and of the logarithms of base colours."""
SMOOTHNESS = 0.02
"""Weight of the map's total variation, as preset `fast` has it."""
BOUND, BOUND_WEIGHT = 0.9, 10.0
"""Base colours above this pay for it, so that light rather than a bound takes up the scale."""
REWEIGHTED = 4
"""Solves for the base colour, in each of which pixels count by the inverse of their last error."""
START_BASE_COLOR, START_ROUGHNESS = 0.3, 4
"""What places start as; roughness by its number."""
MIN_BASE_COLOR = 0.01
"""Of base colours."""


@dataclass(frozen=True)
class PlaceFit:
    """A map and the materials of P places; `roughness` and `metallic` by their numbers in the grids."""

    log_radiance: Float[Tensor, "3 H W"]
    base_color: Float[Tensor, "P 3"]
    roughness: Int[Tensor, " P"]
    metallic: Int[Tensor, " P"]

    @property
    def radiance(self) -> Float[Tensor, "T 3"]:
        """Of the texels, row by row."""
        return self.log_radiance.exp().flatten(1).t()


@torch.no_grad()
def place_transport(places: Places, lobe: Lobe, scene: SceneTracer | None) -> Transport:
    """To N pixels from the texels of a map, in the layers of `from_texels_at`: 84 kB a pixel."""
    environment = EnvironmentLight(ROWS, 1.0).to(places.place.device)
    return from_texels_at(environment, places.observed, ROUGHNESSES, lobe, scene)


def any_map(log_radiance: Float[Tensor, "3 H W"]) -> Float[Tensor, "3 H W"]:
    """A map whose texels and channels have nothing to do with each other."""
    return log_radiance


def fit_places(
    places: Places,
    transport: Transport,
    typical: float,
    metals: bool,
    form: Callable[[Float[Tensor, "3 H W"]], Float[Tensor, "3 H W"]] = any_map,
) -> PlaceFit:
    """Light and materials from a start of grey paint under an even light.

    Args:
        places: with linear radiance.
        transport: of the same pixels.
        typical: radiance of a typical pixel.
        metals: whether metallic may be more than 0.
        form: makes the map of log radiance from as many unknowns.
    """
    device = places.place.device
    count = places.count
    fit = PlaceFit(
        log_radiance=torch.full((3, ROWS, 2 * ROWS), math.log(typical / START_BASE_COLOR), device=device),
        base_color=torch.full((count, 3), START_BASE_COLOR, device=device),
        roughness=torch.full((count,), START_ROUGHNESS, device=device),
        metallic=torch.zeros(count, dtype=torch.long, device=device),
    )
    for turn in range(ROUNDS):
        fit = _better_light(fit, places, transport, typical, STEPS if turn else FIRST_STEPS, form)
        fit = _best_material(fit, places, transport, typical, METALLICS if metals else METALLICS[:1])
    return fit


@torch.no_grad()
def place_errors(fit: PlaceFit, places: Places, transport: Transport, typical: float) -> Float[Tensor, " N"]:
    """Relative error of each pixel, at most 1, mean of its channels."""
    shown = _at_roughness(transport, fit.roughness[places.place])
    sent = torch.einsum("knt,tc->knc", shown.sources, fit.radiance) + shown.scene
    outgoing = _outgoing(sent, fit.base_color[places.place], _metallic(fit)[places.place])
    return _relative_error(outgoing, places, typical).abs().clamp_max(1).mean(-1)


def _at_roughness(transport: Transport, number: Int[Tensor, " N"]) -> Transport:
    """The diffuse, the facing and the grazing part of each pixel at a roughness of its own."""
    rows = torch.arange(len(number), device=number.device)
    layers = torch.stack((torch.zeros_like(number), 1 + 2 * number, 2 + 2 * number))
    return Transport(transport.sources[layers, rows].float(), transport.scene[layers, rows])


def _metallic(fit: PlaceFit) -> Float[Tensor, "P 1"]:
    return torch.tensor(METALLICS, device=fit.metallic.device)[fit.metallic][:, None]


def _outgoing(sent: Tensor, base_color: Tensor, metallic: Tensor) -> Tensor:
    """Radiance from the diffuse, the facing and the grazing part (`lighting.transport`)."""
    diffuse, facing, grazing = sent
    reflectance = 0.04 * (1 - metallic) + base_color * metallic
    return (1 - metallic) * base_color * diffuse + reflectance * facing + grazing


def _relative_error(outgoing: Tensor, places: Places, typical: float) -> Tensor:
    pixel = places.observed.pixel
    return (outgoing - pixel) / (pixel + FLOOR * typical)


def _better_light(
    fit: PlaceFit,
    places: Places,
    transport: Transport,
    typical: float,
    steps: int,
    form: Callable[[Tensor], Tensor],
) -> PlaceFit:
    """The light by descent, and the base colours with it, at the roughness and metallic that places have."""
    shown, metallic = _at_roughness(transport, fit.roughness[places.place]), _metallic(fit)[places.place]
    flat = shown.sources.flatten(0, 1)
    log_radiance = fit.log_radiance.clone().requires_grad_()
    gain = torch.zeros_like(fit.base_color, requires_grad=True)
    groups = [{"params": [log_radiance], "lr": RATE}, {"params": [gain], "lr": GAIN_RATE}]
    optimizer = torch.optim.Adam(groups, betas=(0.9, 0.99))
    with torch.enable_grad():
        for _ in range(steps):
            base_color = fit.base_color * gain.exp()
            sent = (flat @ form(log_radiance).exp().flatten(1).t()).view_as(shown.scene) + shown.scene
            error = _relative_error(
                _outgoing(sent, base_color.clamp(0, 1)[places.place], metallic), places, typical
            )
            loss = functional.smooth_l1_loss(error, torch.zeros_like(error), beta=OUTLIER)
            loss = loss + SMOOTHNESS * total_variation(log_radiance)
            loss = loss + BOUND_WEIGHT * (base_color - BOUND).clamp_min(0).square().mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
    base_color = (fit.base_color * gain.detach().exp()).clamp(MIN_BASE_COLOR, 1)
    return PlaceFit(form(log_radiance).detach(), base_color, fit.roughness, fit.metallic)


@torch.no_grad()
def _best_material(
    fit: PlaceFit, places: Places, transport: Transport, typical: float, metallics: tuple[float, ...]
) -> PlaceFit:
    """Of all pairs of roughness and metallic at a place, the one with the least error (best base colour).

    Radiance is linear in the base colour, b · slope + rest, so the best is a weighted mean.
    """
    layers = torch.stack([part.float() @ fit.radiance for part in transport.sources]) + transport.scene
    diffuse, unit = layers[0], places.observed.pixel + FLOOR * typical
    best = torch.full((places.count,), torch.inf, device=unit.device)
    base_color, roughness, metallic = fit.base_color.clone(), fit.roughness.clone(), fit.metallic.clone()
    for k in range(len(ROUGHNESSES)):
        facing, grazing = layers[1 + 2 * k], layers[2 + 2 * k]
        for j, m in enumerate(metallics):
            slope = ((1 - m) * diffuse + m * facing) / unit
            wanted = (places.observed.pixel - 0.04 * (1 - m) * facing - grazing) / unit
            weight = torch.ones_like(slope)
            for _ in range(REWEIGHTED):
                per_place = places.mean(weight * slope * wanted) / places.mean(
                    weight * slope.square()
                ).clamp_min(1e-12)
                tried = per_place.clamp(MIN_BASE_COLOR, 1)
                error = tried[places.place] * slope - wanted
                weight = 1 / error.abs().clamp_min(OUTLIER)
            size = functional.smooth_l1_loss(
                error, torch.zeros_like(error), beta=OUTLIER, reduction="none"
            ).mean(-1)
            left = places.mean(size)
            better = left < best
            best = torch.where(better, left, best)
            base_color = torch.where(better[:, None], tried, base_color)
            roughness, metallic = torch.where(better, k, roughness), torch.where(better, j, metallic)
    return PlaceFit(fit.log_radiance, base_color, roughness, metallic)
