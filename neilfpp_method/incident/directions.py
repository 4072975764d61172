"""Which incident directions a surface point is asked along."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from neilfpp_method.fields.light import Light
from neilfpp_method.shading.brdf import Lobe
from neilfpp_method.shading.sampling import combine, cosine, sample_directions, specular_lobe
from neilfpp_method.structures import IncidentSamples

__all__ = ["directions_for_viewers", "draw_directions"]

BY_COSINE, BY_LIGHT, BY_LOBE = 24, 24, 3
"""Incident directions of `directions_for_viewers`: by cosine, by the light, and by each viewer's lobe."""

WITHOUT_LOBE = {"mis": "no_lobe", "lobe": "cosine"}
"""A Lambertian surface has no lobe to sample."""


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
    """`count` incident directions per point for one viewer each.

    Args:
        sampler: by name, as of `ShadingConfig.sampler`.
        light: takes part in "mis" where it can be sampled.
        normal, wo: unit, away from the surface; constants.
        roughness: of the surface, a constant.
        count: directions per point.
        lobe: of the specular reflection; none for Lambertian surfaces.
        stochastic: off: the same directions at every call.
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
    """Incident directions that serve all V viewers of a point together, the same at every call.

    Cosine, light and all viewers' lobes, by the balance heuristic. Arguments as of `draw_directions`.
    """
    techniques = [(cosine(normal), BY_COSINE)]
    towards_light = light.technique(normal)
    if towards_light is not None:
        techniques.append((towards_light, BY_LIGHT))
    if lobe is not None:
        techniques += [
            (specular_lobe(normal, direction, roughness, lobe), BY_LOBE) for direction in wo.unbind(1)
        ]
    return combine(techniques, stochastic=False)
