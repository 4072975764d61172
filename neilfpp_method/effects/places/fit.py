"""Jointly fit an environment map and the materials of surface places.

Each place has a base colour, a roughness from a grid, and a metallic from a grid. Two steps alternate: the
best material under the current light is found by trying all pairs of roughness and metallic, and the best
light under the current materials is found by gradient descent.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from neilfpp_method.effects.places.data import ROWS, PlaceData
from neilfpp_method.effects.places.grid import (
    METALLICS,
    MIN_BASE_COLOR,
    ROUGHNESSES,
    best_materials,
    neighbors,
    on_grid,
    relative_error,
)
from neilfpp_method.kernels.products import times_channels
from neilfpp_method.lighting.layered_transport import layers_at
from neilfpp_method.lighting.objective import OUTLIER_ERROR, total_variation, white_balance
from neilfpp_method.lighting.transport import Transport
from neilfpp_method.structures import Material

__all__ = [
    "Permitted",
    "PlaceFit",
    "at_roughness",
    "fit_places",
    "mean_errors",
    "place_errors",
    "seconds_of_step",
]

ROUNDS = 6
"""Number of alternations between light and material."""
FIRST_STEPS = 100
"""Descent steps on the light in the first round."""
STEPS = 40
"""Descent steps on the light in each later round."""
RATE = 0.1
"""Learning rate of log radiance."""
GAIN_RATE = 0.03
"""Learning rate of the logarithms of base colours."""
SMOOTHNESS = 0.02
"""Weight of the map's total variation, as in preset `fast`."""
HIGH_BASE_COLOR = 0.95
"""Base colours above this value are penalised, so that the light takes up the scale before base colours reach
1 and are clamped.
"""
HIGH_BASE_COLOR_WEIGHT = 1.0
"""Weight of that penalty, the mean squared excess."""
SCALE_WEIGHT = 10.0
"""Weight of the squared deviation of the mean log base colour from its given value."""
NEIGHBORS_SHARE = 1 / 200
"""Share of the places whose errors are added when roughness and metallic of a place are chosen. The views of
one place hardly determine them, and neighbouring places are often of one material.
"""
START_BASE_COLOR = 0.3
"""Initial base colour of all places."""
START_ROUGHNESS = 4
"""Index of the initial roughness of all places."""
TIMED_STEPS = 3
"""Number of descent steps that `seconds_of_step` times."""


@dataclass(frozen=True)
class PlaceFit:
    """A map and the materials of P places.

    Attributes:
        log_radiance: logarithm of the radiance of the map.
        base_color: base colour of each place.
        roughness: roughness of each place, as an index in `ROUGHNESSES`.
        metallic: metallic of each place, as an index in `METALLICS`.
    """

    log_radiance: Float[Tensor, "3 H W"]
    base_color: Float[Tensor, "P 3"]
    roughness: Int[Tensor, " P"]
    metallic: Int[Tensor, " P"]

    @property
    def radiance(self) -> Float[Tensor, "T 3"]:
        """Radiance of the texels, row by row."""
        return self.log_radiance.exp().flatten(1).t()

    def material(self, place: Int[Tensor, " N"]) -> Material:
        """Materials of the places with these numbers."""
        return on_grid(self.base_color[place], self.roughness[place], self.metallic[place])

    def brightened(self, factor: float) -> PlaceFit:
        """Base colours that are brighter by a factor, at most 1, under light that is weaker by it."""
        base_color = (self.base_color * factor).clamp_max(1.0)
        return replace(self, log_radiance=self.log_radiance - math.log(factor), base_color=base_color)


def _any_map(log_radiance: Float[Tensor, "3 H W"]) -> Float[Tensor, "3 H W"]:
    """The identity: every texel and channel of the map is a free unknown."""
    return log_radiance


@dataclass(frozen=True)
class Permitted:
    """The lights and materials that a fit may choose from.

    Attributes:
        metals: whether metallic may be greater than 0.
        mean_base_color: value of the geometric mean of base colour over channels and the places that have
            pixels; None if it is free.
        form: projection of log radiance onto the permitted maps.
    """

    metals: bool
    mean_base_color: float | None = None
    form: Callable[[Float[Tensor, "3 H W"]], Float[Tensor, "3 H W"]] = _any_map


def fit_places(
    data: PlaceData, permitted: Permitted, start: PlaceFit | None = None, rounds: int = ROUNDS
) -> PlaceFit:
    """Fit light and materials of places.

    Args:
        data: places with their pixels.
        permitted: the lights and materials to choose from.
        start: initial values; None for a grey dielectric under an even light.
        rounds: number of alternations between light and material.
    """
    places = data.places
    base_color = permitted.mean_base_color or START_BASE_COLOR
    fit = _even_start(data, base_color) if start is None else start
    near = neighbors(places.mean(places.observed.position), max(1, round(NEIGHBORS_SHARE * places.count)))
    metallics = range(len(METALLICS) if permitted.metals else 1)
    for turn in range(rounds):
        steps = FIRST_STEPS if start is None and turn == 0 else STEPS
        fit = _better_light(fit, data, permitted, steps)
        from_map = [times_channels(part.float(), fit.radiance) for part in data.transport.sources]
        parts = torch.stack(from_map) + data.transport.scene
        best = best_materials(parts, places, data.typical, metallics, near)
        fit = PlaceFit(fit.log_radiance, best.base_color, best.roughness, best.metallic)
    return fit


def _even_start(data: PlaceData, base_color: float) -> PlaceFit:
    """A grey dielectric under an even light."""
    device, count = data.places.place.device, data.places.count
    return PlaceFit(
        log_radiance=torch.full((3, ROWS, 2 * ROWS), math.log(data.typical / base_color), device=device),
        base_color=torch.full((count, 3), base_color, device=device),
        roughness=torch.full((count,), START_ROUGHNESS, device=device),
        metallic=torch.zeros(count, dtype=torch.long, device=device),
    )


@torch.no_grad()
def place_errors(fit: PlaceFit, data: PlaceData) -> Float[Tensor, " N"]:
    """Relative error of each pixel, clipped at 1 and averaged over the channels."""
    place = data.places.place
    outgoing = at_roughness(data.transport, fit.roughness[place]).outgoing(fit.material(place), fit.radiance)
    return relative_error(outgoing, data.places, data.typical).abs().clamp_max(1).mean(-1)


def mean_errors(fit: PlaceFit, data: PlaceData) -> Float[Tensor, " P"]:
    """Mean of `place_errors` for each place; NaN for a place without pixels."""
    return data.places.mean_if_shown(place_errors(fit, data))


def at_roughness(transport: Transport, number: Int[Tensor, " N"]) -> Transport:
    """The diffuse, facing and grazing parts of each pixel at the roughness of its place."""
    count = len(ROUGHNESSES)
    sources = layers_at(transport.sources, number, count).float()
    return Transport(sources, layers_at(transport.scene, number, count))


def _better_light(fit: PlaceFit, data: PlaceData, permitted: Permitted, steps: int) -> PlaceFit:
    """Improve the light and the base colours by descent, with fixed roughness and metallic."""
    place = data.places.place
    # The base colour of a place without pixels is arbitrary.
    with_pixels = place.unique()
    selected = at_roughness(data.transport, fit.roughness[place])
    reaching_any = selected.reaching_any()
    selected = selected.select_sources(reaching_any)
    material = fit.material(place)
    mean_transport = selected.sources[0].mean(0)
    log_radiance = fit.log_radiance.clone().requires_grad_()
    gain = torch.zeros_like(fit.base_color, requires_grad=True)
    groups = [{"params": [log_radiance], "lr": RATE}, {"params": [gain], "lr": GAIN_RATE}]
    optimizer = torch.optim.Adam(groups, betas=(0.9, 0.99))
    with torch.enable_grad():
        for _ in range(steps):
            base_color = fit.base_color * gain.exp()
            candidate = replace(material, base_color=base_color.clamp(0, 1)[place])
            radiance = permitted.form(log_radiance).exp().flatten(1).t()[reaching_any]
            outgoing = selected.outgoing(candidate, radiance)
            error = relative_error(outgoing, data.places, data.typical)
            loss = functional.smooth_l1_loss(error, torch.zeros_like(error), beta=OUTLIER_ERROR)
            loss = loss + SMOOTHNESS * total_variation(log_radiance)
            contribution = mean_transport[:, None] * radiance
            loss = loss + white_balance(contribution, contribution.sum(0), data.response)
            loss = loss + HIGH_BASE_COLOR_WEIGHT * (base_color - HIGH_BASE_COLOR).clamp_min(0).square().mean()
            if permitted.mean_base_color is not None:
                scale_error = _log_mean(base_color[with_pixels]) - math.log(permitted.mean_base_color)
                loss = loss + SCALE_WEIGHT * scale_error.square()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
    base_color = (fit.base_color * gain.detach().exp()).clamp(MIN_BASE_COLOR, 1)
    return PlaceFit(permitted.form(log_radiance).detach(), base_color, fit.roughness, fit.metallic)


def _log_mean(base_color: Float[Tensor, "P 3"]) -> Float[Tensor, ""]:
    return base_color.clamp_min(MIN_BASE_COLOR).log().mean()


def seconds_of_step(pixels: int, device: torch.device) -> float:
    """Measure the approximate time of one descent step on the light for this number of pixels, in seconds.

    Most of a step is the multiplication of the transport matrix and of its transpose, which is timed.
    """
    transport = torch.ones(3 * pixels, 2 * ROWS**2, device=device)
    light = torch.ones(2 * ROWS**2, 3, device=device, requires_grad=True)

    def seconds_of(steps: int) -> float:
        began = time.perf_counter()
        with torch.enable_grad():
            for _ in range(steps):
                times_channels(transport, light).sum().backward()
        # `item` waits for the device.
        light.grad.sum().item()
        return time.perf_counter() - began

    # The first step may compile the loops of the product.
    seconds_of(1)
    return seconds_of(TIMED_STEPS) / TIMED_STEPS
