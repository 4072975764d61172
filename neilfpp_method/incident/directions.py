"""Sample the incident directions along which light is evaluated."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from neilfpp_method.fields.light import Light
from neilfpp_method.shading.brdf import Lobe
from neilfpp_method.shading.sampling import combine, cosine, sample_directions, specular_lobe
from neilfpp_method.structures import IncidentSamples

__all__ = ["directions_for_viewers", "draw_directions"]

BY_LIGHT, BY_LOBE = 48, 3
"""Directions of `directions_for_viewers` by technique: light, and the lobe of each viewer."""

WITHOUT_LOBE = {"mis": "no_lobe", "lobe": "cosine"}
"""Samplers that replace those that sample the lobe, for Lambertian surfaces, which have none."""


def draw_directions(
    sampler: str,
    light: Light,
    normal: Float[Tensor, "N 3"],
    wo: Float[Tensor, "N 3"],
    roughness: Float[Tensor, "N 1"],
    count: int,
    lobe: Lobe | None,
    stochastic: bool,
) -> IncidentSamples:
    """Sample `count` incident directions per point, for one viewer per point.

    Args:
        sampler: name of the sampler, see `ShadingConfig.sampler`.
        light: takes part in "mis" and "no_lobe" if it can be sampled.
        normal, wo: unit vectors away from the surface, without gradient.
        roughness: roughness of the surface, without gradient.
        count: directions per point.
        lobe: specular lobe; None for Lambertian surfaces.
        stochastic: whether the directions are random; if False, every call returns the same ones.
    """
    kind = sampler if lobe is not None else WITHOUT_LOBE.get(sampler, sampler)
    return sample_directions(kind, normal, wo, roughness, count, lobe, stochastic, light.technique(normal))


def directions_for_viewers(
    light: Light,
    normal: Float[Tensor, "N 3"],
    wo: Float[Tensor, "N V 3"],
    roughness: Float[Tensor, "N 1"],
    lobe: Lobe | None,
) -> IncidentSamples:
    """Choose incident directions for all V viewers of a point together, the same at every call.

    The light (the cosine if it cannot be sampled) and the lobes of all viewers are combined by the balance
    heuristic. Arguments as in `draw_directions`.
    """
    techniques = [(light.technique(normal) or cosine(normal), BY_LIGHT)]
    if lobe is not None:
        techniques += [
            (specular_lobe(normal, direction, roughness, lobe), BY_LOBE) for direction in wo.unbind(1)
        ]
    return combine(techniques, stochastic=False)
