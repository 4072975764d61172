"""Incident directions along which light is evaluated for several viewers at once."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from neilfpp_method.fields.light import Light
from neilfpp_method.shading.brdf import Lobe
from neilfpp_method.shading.sampling import combine, cosine, specular_lobe
from neilfpp_method.structures import IncidentSamples

__all__ = ["directions_for_viewers"]

BY_LIGHT, BY_LOBE = 48, 3
"""Directions of `directions_for_viewers` by technique: light, and the lobe of each viewer."""


def directions_for_viewers(
    light: Light,
    normal: Float[Tensor, "N 3"],
    wo: Float[Tensor, "N V 3"],
    roughness: Float[Tensor, "N 1"],
    lobe: Lobe | None,
) -> IncidentSamples:
    """Choose incident directions for all V viewers of a point together, the same at every call.

    The light (the cosine if it cannot be sampled) and the lobes of all viewers are combined by the balance
    heuristic.

    Args:
        light: the light.
        normal: unit normals.
        wo: unit directions to the viewers.
        roughness: roughness of the surface.
        lobe: specular lobe; None for Lambertian surfaces.
    """
    techniques = [(light.technique(normal) or cosine(normal), BY_LIGHT)]
    if lobe is not None:
        techniques += [
            (specular_lobe(normal, direction, roughness, lobe), BY_LOBE) for direction in wo.unbind(1)
        ]
    return combine(techniques, stochastic=False)
