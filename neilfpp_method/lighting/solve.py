"""Solve for the light of a scene: an environment map, and lamps if held-back points support them."""

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
"""Number of candidate lamps in one fit."""
FOLDS = 5
"""Number of folds of the points. One fold is held back from the fits with and without lamps and decides
between them; for the first decision every fold is held back in turn.
"""
BLOCKS_OF_FOLD = 6
"""Number of blocks of neighbouring points in a fold. The materials of neighbours have similar errors, so a
lamp that compensates for such errors also lowers the error at held-back neighbours of the fitted points.
Blocks are therefore held back as a whole.
"""
KNOWN_ROWS = 32
"""Rows to which a known map is reduced when only lamps are fitted, because every texel is traced from every
point.
"""


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
    lamps_if_undecided: bool = False,
) -> Evidence | None:
    """Set the map, and lamps if the settings allow them, to the values that best explain the points.

    A known map is left unchanged.

    Args:
        light: the light to set; its current values are the initial values of the fit.
        observed: the surface points.
        material: their material.
        lobe: as in `from_texels`.
        scene: as in `from_texels`.
        objective: the terms of the loss and their weights.
        config: settings of the light. With kind "auto" the light is fitted with and without lamps, and the
            lamps are used if they lower the error at points held back from both fits (`Evidence.favours`).
        first: whether this is the first decision between the two.
        lamps_if_undecided: use lamps even if their gain is not significant, unless it is significantly too
            small. A later fit removes a superfluous lamp, but does not add a missing one: by then its light
            is part of the learned base colour.

    Returns:
        The comparison of the fits with and without lamps; None if the settings decide.
    """
    environment, lamps = light.light, light.lamps
    target = Target(observed.position, material, observed.pixel)
    no_lamps = environment.log_radiance.new_zeros(0, 3)
    # `unknown` are the texels to fit, as a view of the map, so that `copy_` sets them.
    if config.map is None:
        # An even light is a single source, which is stored in the first texel.
        even = environment.even
        unknown = environment.log_radiance[:, :1, :1] if even else environment.log_radiance
        traced = environment.at_most(EVEN_ROWS) if even else environment
        from_map = from_texels(traced, observed, material.roughness, lobe, scene)
        from_map = from_map.sum_sources() if even else from_map
    else:
        unknown = environment.log_radiance.new_zeros(3, 0, 0)
        known = environment.at_most(KNOWN_ROWS)
        from_map = from_texels(known, observed, material.roughness, lobe, scene)
        from_map = from_map.with_strength(known.log_radiance.exp().flatten(1).t())
    map_only = Light(unknown, no_lamps)
    if config.kind == "distant":
        unknown.copy_(fit_light(map_only, from_map, target, objective).log_radiance)
        return None

    places = propose(lamps, observed.position, CANDIDATES)
    from_candidates = from_lamps(places, lamps.radius, observed, material.roughness, lobe, scene)
    from_both = from_map.concatenate(from_candidates)
    intensity = no_lamps.new_zeros(len(places.position), 3)
    intensity[: lamps.count] = lamps.intensity[: lamps.count]
    start = Light(unknown, intensity)
    if config.kind != "auto":
        found, measured = fit_light(start, from_both, target, objective), None
    else:
        # Surfaces learn under the light that is chosen first and then confirm it, so the first decision uses
        # all folds.
        fold = _folds(observed.position)
        gains = []
        for number in range(FOLDS if first else 1):
            held_back, fitted = fold == number, fold != number
            plain = fit_light(map_only, from_map[fitted], target[fitted], objective)
            found = fit_light(start, from_both[fitted], target[fitted], objective)
            transports = (from_map[held_back], from_both[held_back])
            gains.append(compare((plain, found), transports, target[held_back], objective))
        measured = evidence(torch.cat(gains))
        if not measured.favours(chosen=lamps_if_undecided or lamps.count > 0):
            unknown.copy_(plain.log_radiance)
            lamps.place(no_lamps, no_lamps)
            return measured
    unknown.copy_(found.log_radiance)
    merged = merge(places, found.intensity, from_candidates.sources[0].mean(0), len(lamps.position))
    map_light = from_map.with_strength(unknown.exp().flatten(1).t())
    merged = settle_lamps(merged, lamps.radius, map_light, observed, target, lobe, scene, objective)
    # The map was fitted together with the candidates, so it must be fitted again with the refined lamps.
    from_merged = from_lamps(merged.places, lamps.radius, observed, material.roughness, lobe, scene)
    found = fit_light(Light(unknown, merged.intensity), from_map.concatenate(from_merged), target, objective)
    unknown.copy_(found.log_radiance)
    lamps.place(merged.places.position, found.intensity, merged.places.axis)
    return measured


def _folds(position: Float[Tensor, "N 3"]) -> Int[Tensor, " N"]:
    """The fold of each point. Points with the same nearest random centre form a block of a fold."""
    centers = torch.randperm(len(position), device=position.device)[: BLOCKS_OF_FOLD * FOLDS]
    return torch.cdist(position, position[centers]).argmin(1) % FOLDS
