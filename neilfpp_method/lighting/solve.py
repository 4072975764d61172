"""The light of a scene from observations: the map, and lamps where points kept back support them."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from neilfpp_method.fields.environment import EVEN_ROWS
from neilfpp_method.fields.light import LightModel
from neilfpp_method.lighting.candidates import merge, propose
from neilfpp_method.lighting.fit import Evidence, Light, compare, evidence, fit_light
from neilfpp_method.lighting.objective import Objective, Target
from neilfpp_method.lighting.settle import settle_lamps
from neilfpp_method.lighting.transport import from_lamps, from_texels
from neilfpp_method.settings.types import MapLightConfig
from neilfpp_method.shading.brdf import Lobe
from neilfpp_method.structures import Material, Observed, SceneTracer

__all__ = ["solve_light"]

CANDIDATES = 256
"""Places for lamps that one fit tries."""
FOLDS = 5
"""Number of parts. One part is not fitted to, and decides between two lights; at first, each in turn."""
BLOCKS_OF_FOLD = 6
"""Blocks of neighbouring points that make a part. Neighbours share the errors of their material, and a lamp
that makes up for those would be confirmed by a neighbour that was kept back; so a block is kept back
whole.
"""
KNOWN_ROWS = 32
"""Rows of a known map in fits of the lamps before it: such a fit traces every texel from every point."""


@torch.no_grad()
def solve_light(
    light: LightModel,
    observed: Observed,
    material: Material,
    lobe: Lobe | None,
    scene: SceneTracer | None,
    objective: Objective,
    config: MapLightConfig,
    first: bool,
    benefit_of_doubt: bool = False,
) -> Evidence | None:
    """Set the map, and lamps where allowed, to what explains the points. A known map stays.

    Args:
        light: what is set; the search starts from what it is.
        observed, material: surface points, and what they are made of.
        lobe, scene: as of `from_texels`.
        objective: what is minimised.
        config: with "auto" the lamps must earn their place: the fit is done with and without, and they stay
            where they lower the error at points kept back from both (`Evidence.favours`).
        first: nothing has been decided yet.
        benefit_of_doubt: lamps stay out only where it is sure that they are not worth it. Surfaces learn the
            light that they are under: a lamp too many goes out at a later fit, as surfaces then show; a lamp
            that is missing has left its glow on them, and no later fit asks for it.

    Returns:
        What was measured for and against lamps; none where the settings had decided.
    """
    environment, lamps = light.light, light.lamps
    target = Target(observed.position, material, observed.pixel)
    dark = environment.log_radiance.new_zeros(0, 3)
    if config.map is None:
        # An even light is one source, and one texel that stands for all.
        even = environment.even
        sought = environment.log_radiance[:, :1, :1] if even else environment.log_radiance
        seen = environment.at_most(EVEN_ROWS) if even else environment
        texels = from_texels(seen, observed, material.roughness, lobe, scene)
        texels = texels.together() if even else texels
    else:
        sought = environment.log_radiance.new_zeros(3, 0, 0)
        known = environment.at_most(KNOWN_ROWS)
        texels = from_texels(known, observed, material.roughness, lobe, scene)
        texels = texels.lit(known.log_radiance.exp().flatten(1).t())
    plain_start = Light(sought, dark)
    if config.kind == "distant":
        sought.copy_(fit_light(plain_start, texels, target, objective).log_radiance)
        return None

    places = propose(lamps, observed.position, CANDIDATES)
    near = from_lamps(places, lamps.radius, observed, material.roughness, lobe, scene)
    both = texels.beside(near)
    intensity = dark.new_zeros(len(places.position), 3)
    intensity[: lamps.lit] = lamps.intensity[: lamps.lit]
    start = Light(sought, intensity)
    if config.kind != "auto":
        found, measured = fit_light(start, both, target, objective), None
    else:
        # Surfaces then learn under the first choice and confirm it, so it is made on all parts in turn.
        fold = _folds(observed.position)
        gains = []
        for number in range(FOLDS if first else 1):
            kept_back, fitted = fold == number, fold != number
            plain = fit_light(plain_start, texels[fitted], target[fitted], objective)
            found = fit_light(start, both[fitted], target[fitted], objective)
            carried = (texels[kept_back], both[kept_back])
            gains.append(compare((plain, found), carried, target[kept_back], objective))
        measured = evidence(torch.cat(gains))
        if not measured.favours(chosen=benefit_of_doubt or lamps.lit > 0):
            sought.copy_(plain.log_radiance)
            lamps.place(dark, dark)
            return measured
    sought.copy_(found.log_radiance)
    lit = merge(places, found.intensity, near.sources[0].mean(0), len(lamps.position))
    beside = texels.lit(sought.exp().flatten(1).t())
    lit = settle_lamps(lit, lamps.radius, beside, observed, target, lobe, scene, objective)
    # The map was found beside temporary lamps: light between the two may now belong to the other.
    near = from_lamps(lit.places, lamps.radius, observed, material.roughness, lobe, scene)
    found = fit_light(Light(sought, lit.intensity), texels.beside(near), target, objective)
    sought.copy_(found.log_radiance)
    lamps.place(lit.places.position, found.intensity, lit.places.axis)
    return measured


def _folds(position: Float[Tensor, "N 3"]) -> Int[Tensor, " N"]:
    """Each point's part number: that of its block, about the nearest of some randomly drawn points."""
    drawn = torch.randperm(len(position), device=position.device)[: BLOCKS_OF_FOLD * FOLDS]
    return torch.cdist(position, position[drawn]).argmin(1) % FOLDS
