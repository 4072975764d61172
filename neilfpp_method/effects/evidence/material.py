"""Evidence for specular reflection, varying roughness, an environment map and its colours.

Places that many views show are fitted with all of these effects and without each of them. The fits use most
of the views and are compared at pixels of the held-back views. The fits have no lamps; they have metals if
the model has them (`effects.evidence.metals` decides).

The base colour of every place is free. A place without specular reflection therefore contains no information
about the light, and the benefit of an environment map and of its colours is underestimated.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from neilfpp_method.data.pixels.dataset import PixelDataset
from neilfpp_method.effects.evidence.noise import lobe_noise
from neilfpp_method.effects.measurement import Measurement, mean_of
from neilfpp_method.effects.places.data import PlaceData, place_transport
from neilfpp_method.effects.places.fit import (
    FIRST_STEPS,
    ROUNDS,
    STEPS,
    Permitted,
    PlaceFit,
    fit_places,
    mean_errors,
    place_errors,
    seconds_of_step,
)
from neilfpp_method.effects.places.gathering import Split, gather_places
from neilfpp_method.effects.places.grid import ROUGHNESSES
from neilfpp_method.lighting.layered_transport import diffuse_layers, layers_of
from neilfpp_method.lighting.transport import Transport
from neilfpp_method.model import NeilfModel
from neilfpp_method.shading import LOBES

__all__ = ["EFFECTS_AT_PLACES", "THRESHOLD", "judge_material", "material_evidence", "seconds_of_evidence"]

PLACES = 160
"""Maximum number of places. With `VIEWS` this takes seconds and 300 MB on a laptop."""
VIEWS = 20
"""Maximum number of views per place."""
FOLDS = 4
"""Number of folds of the views; one fold is held back at a time."""
TURNS = 2
"""Number of folds that are held back in turn. Two of the four keep the time within bounds."""
MIN_VIEWS = 4
"""Minimum number of views per place: fewer do not distinguish materials."""
THRESHOLD = 0.01
"""Reduction of the relative error above which an effect is worth its cost."""
CARRIED_ROUNDS = 2
"""Alternations of light and material in the fits with one roughness, which start from the fit with all
effects. The other fits start anew, because the light of that fit contains what reflections have revealed.
"""
FITS = 14
"""Time of all measurements at places before one stage, in units of the time of one fit of this size
(estimate): 8 fits, 6 that take a quarter of the time, and the noise of lobe sampling.
"""
OTHER_TIME_SHARE = 1.5
"""Time of all work other than descent, as a share of that of descent (estimate)."""
SHARED_ROUGHNESSES = (2, 4, 6, 8)
"""Indices in `ROUGHNESSES` that are tried as the common roughness of all places."""
MIN_INDEX_DIFFERENCE = 2
"""A place has another roughness than the common one if its index differs by at least this much."""
LIGHT_FORMS: Mapping[str, Callable[[Tensor], Tensor]] = {
    "environment-map": lambda log_radiance: log_radiance.mean((1, 2), keepdim=True).expand_as(log_radiance),
    "coloured-light": lambda log_radiance: log_radiance.mean(0, keepdim=True).expand_as(log_radiance),
}
"""Projection of a map onto the maps that are possible without an effect: a single colour, or grey."""
MEASURED_QUANTITIES: Mapping[str, str] = {
    "reflection": "reduction of the error in held-back views by specular reflection",
    "varying-roughness": "reduction of the error in held-back views by varying roughness, where it differs",
    "environment-map": "reduction of the error in held-back views by a map over a single colour",
    "coloured-light": "reduction of the error in held-back views by colours of the map",
}
"""The quantity that is measured for each effect, as it appears in the table of effects."""
EFFECTS_AT_PLACES = (*MEASURED_QUANTITIES, "lobe-sampling")
"""Names of the effects that are measured at places before a material stage."""


@torch.no_grad()
def material_evidence(
    model: NeilfModel,
    pixels: PixelDataset,
    position: Float[Tensor, "P 3"],
    normal: Float[Tensor, "P 3"],
    names: frozenset[str],
) -> dict[str, Measurement]:
    """Measure the reduction of the relative error of held-back pixels by each effect.

    For lobe sampling it is the reduction of the noise of a pixel.

    Args:
        model: provides the surface and R, the lobe, and whether there are metals.
        pixels: the training pixels.
        position: points on the surface, scene frame; the first `PLACES` are used.
        normal: unit normals at these points.
        names: the effects to measure, a subset of `EFFECTS_AT_PLACES`.

    Returns:
        A measurement for each name. It has no samples if no place is seen by `MIN_VIEWS` views.
    """
    places = gather_places(model, pixels, position[:PLACES], normal[:PLACES], VIEWS).with_at_least(MIN_VIEWS)
    if not len(places.place):
        return {name: Measurement("views of the same place", 0.0, 0.0, THRESHOLD, 0) for name in names}
    transport = place_transport(places, LOBES[model.config.shading.lobe], model.scene)
    data = PlaceData(places, transport, model.facts.median_radiance, model.facts.response)
    judged = judge_material(data, names, model.brdf.metals)
    if "lobe-sampling" not in names:
        return judged.measured
    return {**judged.measured, "lobe-sampling": lobe_noise(model, places, judged.glossy)}


def seconds_of_evidence(device: torch.device) -> float:
    """Estimate the time of the measurements at places before one stage on this machine, in seconds.

    The estimate assumes that every place has `VIEWS` views. Steps of the descent on the light are timed
    (`places.fit.seconds_of_step`); all other work is in proportion.
    """
    step = seconds_of_step(PLACES * VIEWS * (FOLDS - 1) // FOLDS, device)
    return (1 + OTHER_TIME_SHARE) * FITS * (FIRST_STEPS + (ROUNDS - 1) * STEPS) * step


@dataclass(frozen=True)
class Judged:
    """The result of `judge_material`.

    Attributes:
        measured: a measurement for each effect.
        glossy: a fit with all effects.
    """

    measured: dict[str, Measurement]
    glossy: PlaceFit


@dataclass(frozen=True)
class Variant:
    """A fit with all effects, or without one of them.

    Attributes:
        permitted: metals and maps.
        reflects: whether surfaces have a specular lobe.
        roughness: index of the common roughness of all places; None if each place has its own.
    """

    permitted: Permitted
    reflects: bool = True
    roughness: int | None = None

    def restrict(self, data: PlaceData) -> PlaceData:
        """The data with only the specular layers that this variant permits."""
        return replace(data, transport=self._restrict(data.transport))

    def _restrict(self, transport: Transport) -> Transport:
        if not self.reflects:
            keep = torch.zeros(len(transport.sources), 1, 1, device=transport.scene.device)
            keep[: diffuse_layers(len(keep), len(ROUGHNESSES))] = 1
            return Transport(transport.sources * keep.half(), transport.scene * keep)
        if self.roughness is None:
            return transport
        count = len(ROUGHNESSES)
        diffuse, *reflected = layers_of(self.roughness, len(transport.sources), count)
        layers = [diffuse] * diffuse_layers(len(transport.sources), count) + reflected * count
        return Transport(transport.sources[layers], transport.scene[layers])


@dataclass(frozen=True)
class Explained:
    """A fit of a variant and its errors.

    Attributes:
        fit: the fitted light and materials.
        fitted_error: mean relative error of the pixels that were fitted.
        error: mean relative error of each place in the held-back views; NaN if none of them shows it.
    """

    fit: PlaceFit
    fitted_error: float
    error: Float[Tensor, " P"]


def explain(split: Split[PlaceData], variant: Variant, start: PlaceFit | None = None) -> Explained:
    """Fit a variant, from a given fit on if there is one, and evaluate it in the held-back views."""
    known, held_back = variant.restrict(split.known), variant.restrict(split.held_back)
    fit = fit_places(known, variant.permitted, start, ROUNDS if start is None else CARRIED_ROUNDS)
    if variant.roughness is not None:
        fit = replace(fit, roughness=torch.full_like(fit.roughness, variant.roughness))
    return Explained(fit, place_errors(fit, known).mean().item(), mean_errors(fit, held_back))


@torch.no_grad()
def judge_material(data: PlaceData, names: frozenset[str], metals: bool) -> Judged:
    """Measure the reduction of the error in held-back views by each of `names`.

    Args:
        data: places with their pixels.
        names: the effects to measure.
        metals: whether metallic may be greater than 0 in the fits with specular reflection.
    """
    splits = [data.hold_back(turn, FOLDS) for turn in range(TURNS)]

    def explain_all(variant: Variant) -> list[Explained]:
        return [explain(split, variant) for split in splits]

    glossy = Variant(Permitted(metals))
    glossy_fits = explain_all(glossy)
    measured: dict[str, Measurement] = {}
    if "varying-roughness" in names:

        def with_roughness(number: int, turn: int) -> Explained:
            return explain(splits[turn], replace(glossy, roughness=number), glossy_fits[turn].fit)

        shared = min(SHARED_ROUGHNESSES, key=lambda number: with_roughness(number, 0).fitted_error)
        shared_fits = [with_roughness(shared, turn) for turn in range(TURNS)]
        counted = [(one.fit.roughness - shared).abs() >= MIN_INDEX_DIFFERENCE for one in glossy_fits]
        measured["varying-roughness"] = _reduction("varying-roughness", shared_fits, glossy_fits, counted)
    if "reflection" in names:
        matte = Variant(Permitted(metals=False), reflects=False)
        measured["reflection"] = _reduction("reflection", explain_all(matte), glossy_fits)
    for name, form in LIGHT_FORMS.items():
        if name in names:
            limited = Variant(Permitted(metals, form=form))
            measured[name] = _reduction(name, explain_all(limited), glossy_fits)
    return Judged({name: measured[name] for name in MEASURED_QUANTITIES if name in names}, glossy_fits[0].fit)


def _reduction(
    name: str,
    without: Sequence[Explained],
    having: Sequence[Explained],
    counted: Sequence[Bool[Tensor, " P"]] | None = None,
) -> Measurement:
    """The reduction of the error by an effect, averaged over the places that are `counted`."""
    gains = [one.error - other.error for one, other in zip(without, having, strict=True)]
    if counted is not None:
        gains = [gain[rows] for gain, rows in zip(gains, counted, strict=True)]
    gain = torch.cat(gains)
    return mean_of(gain[gain.isfinite()], MEASURED_QUANTITIES[name], THRESHOLD)
