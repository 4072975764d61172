"""Evidence for sampling the specular lobe: how much less noise a shaded pixel has with it.

A rough surface gains nothing: what the lobe draws, the cosine draws as well. So places whose light and
material are fitted are shaded again and again with either set of directions, as many as a training step has,
and the spread of the results is compared.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.effects.measurement import Measurement, mean_of
from neilfpp_method.effects.place_fit import METALLICS, ROUGHNESSES, PlaceFit
from neilfpp_method.effects.places import Places
from neilfpp_method.fields.environment import EnvironmentLight
from neilfpp_method.fields.lamps import Lamps
from neilfpp_method.incident import Sources, arriving, draw_directions
from neilfpp_method.lighting.objective import FLOOR
from neilfpp_method.model import NeilfModel
from neilfpp_method.shading import LOBES, shade
from neilfpp_method.structures import Material

__all__ = ["WORTH", "lobe_noise"]

WORTH = 0.01
"""Relative noise of a pixel that the lobe must save."""
TIMES = 8
"""That a pixel is shaded; its spread is then known to a quarter."""


@torch.no_grad()
def lobe_noise(model: NeilfModel, places: Places, fit: PlaceFit) -> Measurement:
    """How much lower the relative noise of a training step's pixels is where the lobe is sampled.

    Args:
        model: its surface, what it sends, and how many directions it takes.
        places: one pixel of each is shaded.
        fit: their materials, and the map.
    """
    what = "noise of a pixel that sampling the lobe saves"
    shown, first = torch.unique(places.place, return_inverse=True)
    rows = torch.zeros_like(shown).scatter_(0, first, torch.arange(len(first), device=first.device))
    observed = places.observed[rows]
    device = shown.device
    material = Material(
        fit.base_color[shown],
        torch.tensor(ROUGHNESSES, device=device)[fit.roughness[shown]][:, None],
        torch.tensor(METALLICS, device=device)[fit.metallic[shown]][:, None],
    )
    light = EnvironmentLight(fit.log_radiance.shape[1], 1.0).to(device)
    light.show(fit.log_radiance.exp())
    sources = Sources(light, Lamps(0, model.lamps.radius).to(device), model.scene)

    lobe = LOBES[model.config.shading.lobe]

    def noise(sampler: str) -> Float[Tensor, " P"]:
        colors = []
        for _ in range(TIMES):
            drawn = draw_directions(
                sampler,
                light,
                observed.normal,
                observed.wo,
                material.roughness,
                model.config.shading.train_samples,
                lobe,
                stochastic=True,
            )
            arrived = arriving(sources, observed.position, drawn)
            colors.append(shade(material, observed.normal, observed.wo, arrived, lobe).color)
        spread = torch.stack(colors).std(0, correction=1)
        return (spread / (observed.pixel + FLOOR * model.facts.median_radiance)).clamp_max(1).mean(-1)

    return mean_of(noise("no_lobe") - noise("mis"), what, WORTH)
