"""Jointly fit an environment map and the materials of surface places.

Each place has a base colour, a roughness from a grid, and a metallic from a grid. Because there are few
places, the transport is stored as a matrix for each roughness. Two steps alternate: the best material under
the current light is found by trying all pairs of roughness and metallic, and the best light under the current
materials is found by gradient descent.
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

from neilfpp_method.effects.material_grid import (
    METALLICS,
    MIN_BASE_COLOR,
    ROUGHNESSES,
    best_materials,
    neighbors,
    on_grid,
    outgoing_radiance,
    relative_error,
)
from neilfpp_method.effects.places import Places
from neilfpp_method.fields.environment import EnvironmentLight
from neilfpp_method.lighting.objective import OUTLIER, total_variation
from neilfpp_method.lighting.transport import Transport, from_texels_at
from neilfpp_method.shading.brdf import Lobe
from neilfpp_method.shading.frame import safe_normalize
from neilfpp_method.structures import Material, Observed, SceneTracer

__all__ = [
    "PlaceFit",
    "any_map",
    "fit_places",
    "place_errors",
    "place_transport",
    "seconds_of_step",
]

ROWS = 16
"""Rows of the map, whose texels are 11° high. Finer detail is left to training, which uses more pixels."""
DIRECTIONS = 4
"""Random directions per texel and pixel: a lobe of roughness 0.2 is narrower than a texel."""
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
TRIED = 3
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


@torch.no_grad()
def place_transport(places: Places, lobe: Lobe, scene: SceneTracer | None) -> Transport:
    """The transport from the texels of a map to N pixels, with the layers of `from_texels_at`.

    It takes 21 kB per pixel. Rays are traced once per place, from the mean of the points that its views hit.
    """
    environment = EnvironmentLight(ROWS, 1.0).to(places.place.device)
    position, normal = places.mean(places.observed.position), places.mean(places.observed.normal)
    points = Observed(position, safe_normalize(normal), normal, torch.zeros_like(normal))
    drawn = [
        from_texels_at(environment, points, places.observed, places.place, ROUGHNESSES, lobe, scene)
        for _ in range(DIRECTIONS)
    ]
    sources, scene_light = (
        functools.reduce(torch.add, (getattr(part, name) / DIRECTIONS for part in drawn))
        for name in ("sources", "scene")
    )
    return Transport(sources, scene_light)


def seconds_of_step(pixels: int, device: torch.device) -> float:
    """Measure the approximate time of one descent step on the light for this number of pixels, in seconds.

    Most of a step is the multiplication of the transport matrix and of its transpose, which is timed.
    """
    transport = torch.ones(3 * pixels, 2 * ROWS**2, device=device)
    light = torch.ones(2 * ROWS**2, 3, device=device)
    began = time.perf_counter()
    for _ in range(TRIED):
        back = transport.T @ (transport @ light)
    # `item` waits for the device.
    back.sum().item()
    return (time.perf_counter() - began) / TRIED


def any_map(log_radiance: Float[Tensor, "3 H W"]) -> Float[Tensor, "3 H W"]:
    """The identity: every texel and channel of the map is a free unknown."""
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
    """Fit light and materials of places.

    Args:
        places: places with their pixels, in linear radiance.
        transport: the transport to these pixels.
        typical: radiance of a typical pixel.
        metals: whether metallic may be greater than 0.
        mean_base_color: value of the geometric mean of base colour over places and channels; None if it is
            free.
        start: initial values; None for a grey dielectric under an even light.
        rounds: number of alternations between light and material.
        form: projection of log radiance onto the permitted maps.
    """
    base_color = START_BASE_COLOR if mean_base_color is None else mean_base_color
    fit = _even_start(places, typical, base_color) if start is None else start
    near = neighbors(places.mean(places.observed.position), NEIGHBORS_SHARE)
    for turn in range(rounds):
        steps = FIRST_STEPS if start is None and turn == 0 else STEPS
        fit = _better_light(fit, places, transport, typical, steps, mean_base_color, form)
        arriving = torch.stack([part.float() @ fit.radiance for part in transport.sources]) + transport.scene
        best = best_materials(arriving, places, typical, METALLICS if metals else METALLICS[:1], near)
        fit = PlaceFit(fit.log_radiance, best.base_color, best.roughness, best.metallic)
    return fit


def _even_start(places: Places, typical: float, base_color: float) -> PlaceFit:
    """A grey dielectric under an even light."""
    device, count = places.place.device, places.count
    return PlaceFit(
        log_radiance=torch.full((3, ROWS, 2 * ROWS), math.log(typical / base_color), device=device),
        base_color=torch.full((count, 3), base_color, device=device),
        roughness=torch.full((count,), START_ROUGHNESS, device=device),
        metallic=torch.zeros(count, dtype=torch.long, device=device),
    )


@torch.no_grad()
def place_errors(fit: PlaceFit, places: Places, transport: Transport, typical: float) -> Float[Tensor, " N"]:
    """Relative error of each pixel, clipped at 1 and averaged over the channels."""
    selected = _at_roughness(transport, fit.roughness[places.place])
    sent = selected.arriving(fit.radiance)
    material = fit.material(places.place)
    outgoing = outgoing_radiance(sent, material.base_color, material.metallic)
    return relative_error(outgoing, places, typical).abs().clamp_max(1).mean(-1)


def _at_roughness(transport: Transport, number: Int[Tensor, " N"]) -> Transport:
    """The diffuse, facing and grazing parts of each pixel at the roughness of its place."""
    rows = torch.arange(len(number), device=number.device)
    layers = torch.stack((torch.zeros_like(number), 1 + 2 * number, 2 + 2 * number))
    return Transport(transport.sources[layers, rows].float(), transport.scene[layers, rows])


def _better_light(
    fit: PlaceFit,
    places: Places,
    transport: Transport,
    typical: float,
    steps: int,
    mean_base_color: float | None,
    form: Callable[[Tensor], Tensor],
) -> PlaceFit:
    """Improve the light and the base colours by descent, with fixed roughness and metallic."""
    selected = _at_roughness(transport, fit.roughness[places.place])
    metallic = fit.material(places.place).metallic
    log_radiance = fit.log_radiance.clone().requires_grad_()
    gain = torch.zeros_like(fit.base_color, requires_grad=True)
    groups = [{"params": [log_radiance], "lr": RATE}, {"params": [gain], "lr": GAIN_RATE}]
    optimizer = torch.optim.Adam(groups, betas=(0.9, 0.99))
    with torch.enable_grad():
        for _ in range(steps):
            base_color = fit.base_color * gain.exp()
            sent = selected.arriving(form(log_radiance).exp().flatten(1).t())
            outgoing = outgoing_radiance(sent, base_color.clamp(0, 1)[places.place], metallic)
            error = relative_error(outgoing, places, typical)
            loss = functional.smooth_l1_loss(error, torch.zeros_like(error), beta=OUTLIER)
            loss = loss + SMOOTHNESS * total_variation(log_radiance)
            loss = loss + HIGH_BASE_COLOR_WEIGHT * (base_color - HIGH_BASE_COLOR).clamp_min(0).square().mean()
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
