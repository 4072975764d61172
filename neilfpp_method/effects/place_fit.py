"""Light and materials that explain some places together: an environment map, and at each place one base
colour, one roughness of a grid, and one metallic of a grid.

With few places everything is small: transport is a matrix for each roughness, the best material under a light
is found by trying all pairs of roughness and metallic, the best light under the materials by descent, and the
two take turns.
"""

from __future__ import annotations

import functools
import math
import time
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
from neilfpp_method.structures import Material, SceneTracer

__all__ = [
    "PlaceFit",
    "any_map",
    "fit_places",
    "place_errors",
    "place_transport",
    "seconds_of_step",
]

ROUGHNESSES = (0.08, 0.14, 0.2, 0.28, 0.36, 0.45, 0.55, 0.66, 0.8, 1.0)
"""Of the grid; the lobe's width changes by about a half from one to the next."""
METALLICS = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)
"""Of the grid."""
ROWS = 16
"""Of the map: texels of 12°. What is finer is left to training, which sees more pixels."""
DIRECTIONS = 4
"""Directions in each texel for each pixel: lobes of roughness 0.2 are narrower than a texel."""
ROUNDS = 6
"""Turns of material and light."""
FIRST_STEPS, STEPS = 100, 40
"""Of the light in the first turn and in each later one."""
RATE, GAIN_RATE = 0.1, 0.03
"""Of log radiance, and of the logarithms of base colours."""
SMOOTHNESS = 0.02
"""Weight of the map's total variation, as preset `fast` has it."""
BOUND, BOUND_WEIGHT = 0.95, 1.0
"""Base colours above this pay for it, so that light rather than a bound takes up the scale."""
SCALE_WEIGHT = 10.0
"""Of the squared distance of the mean log base colour from where it is held."""
NEIGHBOURS_SHARE = 1 / 200
"""Share of the places that decide together on roughness and metallic, as neighbours often are of one
material, and the views of one place hardly tell them.
"""
REWEIGHTED = 4
"""Solves for the base colour, in each of which pixels count by the inverse of their last error."""
START_BASE_COLOR, START_ROUGHNESS = 0.3, 4
"""What places start as; roughness by its number."""
MIN_BASE_COLOR = 0.01
"""Darker places count as this dark."""
TRIED = 3
"""Products that `seconds_of_step` measures."""


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

    def material(self, place: Int[Tensor, " N"]) -> Material:
        """Of places by number."""
        roughness = torch.tensor(ROUGHNESSES, device=place.device)[self.roughness[place]]
        metallic = torch.tensor(METALLICS, device=place.device)[self.metallic[place]]
        return Material(self.base_color[place], roughness[:, None], metallic[:, None])


@torch.no_grad()
def place_transport(places: Places, lobe: Lobe, scene: SceneTracer | None) -> Transport:
    """To N pixels from the texels of a map, in the layers of `from_texels_at`: 21 kB a pixel."""
    environment = EnvironmentLight(ROWS, 1.0).to(places.place.device)
    drawn = [
        from_texels_at(environment, places.observed, ROUGHNESSES, lobe, scene) for _ in range(DIRECTIONS)
    ]
    sources, scene_light = (
        functools.reduce(torch.add, (getattr(part, name) / DIRECTIONS for part in drawn))
        for name in ("sources", "scene")
    )
    return Transport(sources, scene_light)


def seconds_of_step(pixels: int, device: torch.device) -> float:
    """Measure about how long one step of the light's descent takes for so many pixels.

    Most of a step are the products of the transport to all pixels with the texels of the map, and back.
    """
    transport = torch.ones(3 * pixels, 2 * ROWS**2, device=device)
    light = torch.ones(2 * ROWS**2, 3, device=device)
    began = time.perf_counter()
    for _ in range(TRIED):
        back = transport.T @ (transport @ light)
    back.sum().item()  # waits for a device
    return (time.perf_counter() - began) / TRIED


def any_map(log_radiance: Float[Tensor, "3 H W"]) -> Float[Tensor, "3 H W"]:
    """A map whose texels and channels have nothing to do with each other."""
    return log_radiance


def fit_places(
    places: Places,
    transport: Transport,
    typical: float,
    metals: bool,
    mean_base_color: float | None = None,
    start: PlaceFit | None = None,
    rounds: int = ROUNDS,
    form: Callable[[Float[Tensor, "3 H W"]], Float[Tensor, "3 H W"]] = any_map,
) -> PlaceFit:
    """Light and materials of places.

    Args:
        places: with linear radiance.
        transport: of the same pixels.
        typical: radiance of a typical pixel.
        metals: whether metallic may be more than 0.
        mean_base_color: where the geometric mean over places and channels is held; none: it is free.
        start: what the search starts from; none: grey paint under an even light.
        rounds: turns of light and material.
        form: makes the map of log radiance from as many unknowns.
    """
    held = START_BASE_COLOR if mean_base_color is None else mean_base_color
    fit = _even_start(places, typical, held) if start is None else start
    near = _neighbours(places)
    for turn in range(rounds):
        steps = FIRST_STEPS if start is None and turn == 0 else STEPS
        fit = _better_light(fit, places, transport, typical, steps, mean_base_color, form)
        fit = _best_material(fit, places, transport, typical, METALLICS if metals else METALLICS[:1], near)
    return fit


def _even_start(places: Places, typical: float, base_color: float) -> PlaceFit:
    """Grey paint under an even light."""
    device, count = places.place.device, places.count
    return PlaceFit(
        log_radiance=torch.full((3, ROWS, 2 * ROWS), math.log(typical / base_color), device=device),
        base_color=torch.full((count, 3), base_color, device=device),
        roughness=torch.full((count,), START_ROUGHNESS, device=device),
        metallic=torch.zeros(count, dtype=torch.long, device=device),
    )


def _neighbours(places: Places) -> Int[Tensor, "P K"]:
    """Of each place itself and those next to it."""
    middle = places.mean(places.observed.position)
    count = max(1, min(places.count, round(NEIGHBOURS_SHARE * places.count)))
    return torch.cdist(middle, middle).topk(count, largest=False).indices


@torch.no_grad()
def place_errors(fit: PlaceFit, places: Places, transport: Transport, typical: float) -> Float[Tensor, " N"]:
    """Relative error of each pixel, at most 1, mean of its channels."""
    shown = _at_roughness(transport, fit.roughness[places.place])
    sent = shown.arriving(fit.radiance)
    material = fit.material(places.place)
    outgoing = _outgoing(sent, material.base_color, material.metallic)
    return _relative_error(outgoing, places, typical).abs().clamp_max(1).mean(-1)


def _at_roughness(transport: Transport, number: Int[Tensor, " N"]) -> Transport:
    """The diffuse, the facing and the grazing part of each pixel at a roughness of its own."""
    rows = torch.arange(len(number), device=number.device)
    layers = torch.stack((torch.zeros_like(number), 1 + 2 * number, 2 + 2 * number))
    return Transport(transport.sources[layers, rows].float(), transport.scene[layers, rows])


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
    mean_base_color: float | None,
    form: Callable[[Tensor], Tensor],
) -> PlaceFit:
    """The light by descent, and the base colours with it, at the roughness and metallic that places have."""
    shown = _at_roughness(transport, fit.roughness[places.place])
    metallic = fit.material(places.place).metallic
    log_radiance = fit.log_radiance.clone().requires_grad_()
    gain = torch.zeros_like(fit.base_color, requires_grad=True)
    groups = [{"params": [log_radiance], "lr": RATE}, {"params": [gain], "lr": GAIN_RATE}]
    optimizer = torch.optim.Adam(groups, betas=(0.9, 0.99))
    with torch.enable_grad():
        for _ in range(steps):
            base_color = fit.base_color * gain.exp()
            sent = shown.arriving(form(log_radiance).exp().flatten(1).t())
            error = _relative_error(
                _outgoing(sent, base_color.clamp(0, 1)[places.place], metallic), places, typical
            )
            loss = functional.smooth_l1_loss(error, torch.zeros_like(error), beta=OUTLIER)
            loss = loss + SMOOTHNESS * total_variation(log_radiance)
            loss = loss + BOUND_WEIGHT * (base_color - BOUND).clamp_min(0).square().mean()
            if mean_base_color is not None:
                off = _log_mean(base_color) - math.log(mean_base_color)
                loss = loss + SCALE_WEIGHT * off.square()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
    base_color = (fit.base_color * gain.detach().exp()).clamp(MIN_BASE_COLOR, 1)
    return PlaceFit(form(log_radiance).detach(), base_color, fit.roughness, fit.metallic)


def _log_mean(base_color: Float[Tensor, "P 3"]) -> Float[Tensor, ""]:
    return base_color.clamp_min(MIN_BASE_COLOR).log().mean()


@torch.no_grad()
def _best_material(
    fit: PlaceFit,
    places: Places,
    transport: Transport,
    typical: float,
    metallics: tuple[float, ...],
    near: Int[Tensor, "P K"],
) -> PlaceFit:
    """Of all pairs of roughness and metallic at a place the one whose best base colours leave the smallest
    error there and at the places near it.

    Radiance is linear in the base colour, b · slope + rest, so the best is a weighted mean.
    """
    layers = torch.stack([part.float() @ fit.radiance for part in transport.sources]) + transport.scene
    diffuse, unit = layers[0], places.observed.pixel + FLOOR * typical
    pixels = torch.bincount(places.place, minlength=places.count).to(unit.dtype)
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
            left = (pixels * places.mean(size))[near].sum(1) / pixels[near].sum(1).clamp_min(1)
            better = left < best
            best = torch.where(better, left, best)
            base_color = torch.where(better[:, None], tried, base_color)
            roughness, metallic = torch.where(better, k, roughness), torch.where(better, j, metallic)
    return PlaceFit(fit.log_radiance, base_color, roughness, metallic)
