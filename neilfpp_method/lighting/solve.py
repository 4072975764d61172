"""Solve for the light of a scene: an environment map, and lamps if held-back points support them."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from neilfpp_method.fields.environment import EVEN_ROWS, EnvironmentLight
from neilfpp_method.fields.lamps import Lamps
from neilfpp_method.fields.light import LightModel
from neilfpp_method.lighting.candidates import FoundLamps, merge_lamps, propose
from neilfpp_method.lighting.fit import CarriedLight, Evidence, MapAndLamps, error_reduction, evidence
from neilfpp_method.lighting.fit_points import FitPoints
from neilfpp_method.lighting.objective import Objective, Target
from neilfpp_method.lighting.settle import settle_lamps
from neilfpp_method.settings.types import MapLightConfig

__all__ = ["refit_light", "solve_light"]

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
    points: FitPoints,
    objective: Objective,
    config: MapLightConfig,
    first: bool,
    lamps_if_undecided: bool = False,
) -> Evidence | None:
    """Set the map, and lamps if the settings allow them, to the values that best explain the points.

    A known map is left unchanged.

    Args:
        light: the light to set; its current values are the initial values of the fit.
        points: the surface points.
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
    lamps, target = light.lamps, points.target
    map_only = _map_only(light.light, points, is_known=config.map is not None)
    unknown = map_only.light.log_radiance
    if config.kind == "distant":
        unknown.copy_(map_only.fit(target, objective).log_radiance)
        return None

    places = propose(lamps, points.observed.position, CANDIDATES)
    from_candidates = points.from_lamps(places, lamps.radius)
    intensity = unknown.new_zeros(len(places.position), 3)
    intensity[: lamps.count] = lamps.lit_intensity
    start = CarriedLight(MapAndLamps(unknown, intensity), map_only.transport.concatenate(from_candidates))
    measured = None
    if config.kind == "auto":
        compared = _compare_at_held_back_points(map_only, start, target, objective, FOLDS if first else 1)
        fitted, measured = compared.with_lamps, compared.evidence
        if not measured.favours(chosen=lamps_if_undecided or lamps.count > 0):
            unknown.copy_(compared.without_lamps.log_radiance)
            lamps.switch_off()
            return measured
    else:
        fitted = start.fit(target, objective)
    unknown.copy_(fitted.log_radiance)
    reach = from_candidates.sources[0].mean(0)
    merged = merge_lamps(places, fitted.intensity, reach, max_lamps=len(lamps.position))
    _settle(lamps, merged, map_only, points, objective)
    return measured


@torch.no_grad()
def refit_light(light: LightModel, points: FitPoints, objective: Objective, config: MapLightConfig) -> None:
    """Fit the map and the intensities of the lamps, whose places are kept. A known map is left unchanged."""
    map_only = _map_only(light.light, points, is_known=config.map is not None)
    _fit_with(
        light.lamps,
        FoundLamps(light.lamps.lit_places, light.lamps.lit_intensity),
        map_only,
        points,
        objective,
    )


def _settle(
    lamps: Lamps, merged: FoundLamps, map_only: CarriedLight, points: FitPoints, objective: Objective
) -> None:
    """Move merged lamps to where they explain the points best, fit map and lamps again, and set both.

    The map was fitted together with the candidates, so it must be fitted again with the lamps in their place.
    """
    map_light = map_only.transport.with_strength(map_only.light.log_radiance.exp().flatten(1).t())
    settled = settle_lamps(merged, lamps.radius, map_light, points, objective)
    _fit_with(lamps, settled, map_only, points, objective)


def _fit_with(
    lamps: Lamps, start: FoundLamps, map_only: CarriedLight, points: FitPoints, objective: Objective
) -> None:
    """Fit the map and the intensities of lamps at these places, and set both."""
    unknown, places = map_only.light.log_radiance, start.places
    transport = map_only.transport.concatenate(points.from_lamps(places, lamps.radius))
    fitted = CarriedLight(MapAndLamps(unknown, start.intensity), transport).fit(points.target, objective)
    unknown.copy_(fitted.log_radiance)
    lamps.place(places.position.clone(), fitted.intensity, places.axis.clone())


def _map_only(environment: EnvironmentLight, points: FitPoints, is_known: bool) -> CarriedLight:
    """The map without lamps. Its `log_radiance` is a view of the texels to fit, so that `copy_` sets them."""
    no_lamps = environment.log_radiance.new_zeros(0, 3)
    if is_known:
        known = environment.at_most(KNOWN_ROWS)
        from_known = points.from_texels(known).with_strength(known.log_radiance.exp().flatten(1).t())
        return CarriedLight(MapAndLamps(environment.log_radiance.new_zeros(3, 0, 0), no_lamps), from_known)
    if environment.even:
        # An even light is a single source, which is stored in the first texel.
        from_even = points.from_texels(environment.at_most(EVEN_ROWS)).sum_sources()
        return CarriedLight(MapAndLamps(environment.log_radiance[:, :1, :1], no_lamps), from_even)
    return CarriedLight(MapAndLamps(environment.log_radiance, no_lamps), points.from_texels(environment))


@dataclass(frozen=True)
class _Compared:
    """Fits of the light without and with lamps, and their comparison.

    Attributes:
        without_lamps: the fit without lamps while the last fold was held back.
        with_lamps: the fit with lamps while the last fold was held back.
        evidence: the comparison at the points of all folds that were held back.
    """

    without_lamps: MapAndLamps
    with_lamps: MapAndLamps
    evidence: Evidence


def _compare_at_held_back_points(
    map_only: CarriedLight, with_lamps: CarriedLight, target: Target, objective: Objective, folds: int
) -> _Compared:
    """Fit the light without and with lamps while each of the first `folds` folds is held back in turn.

    The first decision uses all folds, because later ones are biased towards it: the base colour is learned
    under the light that was chosen first, and then supports that light.
    """
    fold = _folds(target.position)
    gains = []
    for number in range(folds):
        held_back, fitted = fold == number, fold != number
        without = map_only[fitted].fit(target[fitted], objective)
        having = with_lamps[fitted].fit(target[fitted], objective)
        gain = error_reduction(
            map_only[held_back].with_light(without),
            with_lamps[held_back].with_light(having),
            target[held_back],
            objective,
        )
        gains.append(gain)
    return _Compared(without, having, evidence(torch.cat(gains)))


def _folds(position: Float[Tensor, "N 3"]) -> Int[Tensor, " N"]:
    """The fold of each point. Points with the same nearest random centre form a block of a fold."""
    centers = torch.randperm(len(position), device=position.device)[: BLOCKS_OF_FOLD * FOLDS]
    return torch.cdist(position, position[centers]).argmin(1) % FOLDS
