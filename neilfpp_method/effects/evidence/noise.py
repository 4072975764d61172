"""Evidence for importance sampling of the specular lobe: the reduction of the noise of a shaded pixel.

On a rough surface lobe sampling reduces no noise, because the lobe is about as wide as the cosine. So places
with fitted light and material are shaded repeatedly with and without lobe sampling, with as many directions
as in a training step, and the standard deviations of the results are compared.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.effects.measurement import Measurement, mean_of
from neilfpp_method.effects.places.fit import PlaceFit
from neilfpp_method.effects.places.gathering import Places
from neilfpp_method.fields.environment import EnvironmentLight
from neilfpp_method.fields.lamps import Lamps
from neilfpp_method.incident import Sources, arriving
from neilfpp_method.lighting.objective import ERROR_FLOOR
from neilfpp_method.model import NeilfModel
from neilfpp_method.shading import LOBES, Sampling, sample_directions, shade

__all__ = ["THRESHOLD", "lobe_noise"]

THRESHOLD = 0.01
"""Reduction of the relative noise of a pixel above which the lobe is sampled."""
SHADINGS = 8
"""Number of times that a pixel is shaded; its standard deviation is then known to about 25 %."""


@torch.no_grad()
def lobe_noise(model: NeilfModel, places: Places, fit: PlaceFit) -> Measurement:
    """Measure the reduction of the relative noise of training pixels by lobe sampling.

    Args:
        model: provides the surface, R, and the number of directions per pixel.
        places: the places; one pixel of each is shaded.
        fit: their materials, and the map.
    """
    what = "reduction of the noise of a pixel by lobe sampling"
    numbers, place = torch.unique(places.place, return_inverse=True)
    rows = torch.zeros_like(numbers).scatter_(0, place, torch.arange(len(place), device=place.device))
    observed = places.observed[rows]
    device = numbers.device
    material = fit.material(numbers)
    light = EnvironmentLight(fit.log_radiance.shape[1], 1.0).to(device)
    light.show(fit.log_radiance.exp())
    sources = Sources(light, Lamps(0, model.lamps.radius).to(device), model.scene)
    count, lobe = model.config.shading.train_samples, LOBES[model.config.shading.lobe]

    def noise(sampler: str) -> Float[Tensor, " P"]:
        sampling = Sampling(sampler, count, lobe, stochastic=True)
        colors = []
        for _ in range(SHADINGS):
            drawn = sample_directions(
                sampling, observed.normal, observed.wo, material, light.technique(observed.normal)
            )
            arrived = arriving(sources, observed.position, drawn)
            colors.append(shade(material, observed.normal, observed.wo, arrived, lobe).color)
        spread = torch.stack(colors).std(0, correction=1)
        return (spread / (observed.pixel + ERROR_FLOOR * model.facts.median_radiance)).clamp_max(1).mean(-1)

    return mean_of(noise("no_lobe") - noise("mis"), what, THRESHOLD)
