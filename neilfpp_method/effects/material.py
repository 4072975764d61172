"""Evidence for reflection, metals, varying roughness, an uneven light and its colours: places that many views
show, explained with each of them and without.

A dark gloss under a bright light explains a single view of a metal, and a metal explains a single view of a
paint. How a place changes from view to view tells them apart. So light and materials are fitted to most
views, with something and without it, and compared at pixels of the other views: metals first, and all else
with metals where they are worth it. Lamps are no part of these fits.

The base colour of every place is free. So a place without gloss says nothing of the light, and what an
uneven light or its colours save is less than what they are worth.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from neilfpp_method.data.pixels import PixelDataset
from neilfpp_method.effects.measurement import Measurement, mean_of
from neilfpp_method.effects.noise import lobe_noise
from neilfpp_method.effects.place_fit import (
    FIRST_STEPS,
    METALLICS,
    ROUGHNESSES,
    ROUNDS,
    STEPS,
    PlaceFit,
    any_map,
    fit_places,
    place_errors,
    place_transport,
    seconds_of_step,
)
from neilfpp_method.effects.places import Places, gather_places
from neilfpp_method.lighting.transport import Transport
from neilfpp_method.model import NeilfModel
from neilfpp_method.shading import LOBES

__all__ = ["JUDGED", "WORTH", "judge_material", "material_evidence", "seconds_of_evidence"]

PLACES, VIEWS = 160, 20
"""How many places, and of each at most so many views: seconds, and 300 MB, on a laptop."""
FOLDS, TURNS = 4, 2
"""Of the views one in four is kept back, in two of the four possible ways."""
MIN_VIEWS = 4
"""Views that must show a place: fewer do not tell materials apart."""
WORTH = 0.01
"""Relative error that an effect must save."""
FITS, REST = 20, 0.5
"""Of the estimate of how long a look at places takes: the number of fits (16, and some for the noise of lobe
sampling), and the share that other work adds to their descents.
"""
METAL = 0.5
"""Metallic above which a place is taken for metal."""


SHARED = (2, 4, 6, 8)
"""Roughnesses that all places may share, by their numbers in the grid."""
ANOTHER = 2
"""Steps of the grid by which the roughness of a place must be off from the shared one to be another."""
LIGHT_FORMS: Mapping[str, Callable[[Tensor], Tensor]] = {
    "environment-map": lambda log_radiance: log_radiance.mean((1, 2), keepdim=True).expand_as(log_radiance),
    "coloured-light": lambda log_radiance: log_radiance.mean(0, keepdim=True).expand_as(log_radiance),
}
"""What is left of a map without an effect: one colour, or shades of grey."""
SAVED: Mapping[str, str] = {
    "reflection": "error that reflection saves in views kept back",
    "metals": "error that metals save in views kept back, at places taken for metal",
    "varying-roughness": "error that other roughnesses save in views kept back, at places that have them",
    "environment-map": "error that a map saves over one colour in views kept back",
    "coloured-light": "error that colours of the map save in views kept back",
}
JUDGED = (*SAVED, "lobe-sampling")
"""What these places can judge, by the names of the catalogue."""


@torch.no_grad()
def material_evidence(
    model: NeilfModel,
    pixels: PixelDataset,
    position: Float[Tensor, "P 3"],
    normal: Float[Tensor, "P 3"],
    names: frozenset[str],
) -> dict[str, Measurement]:
    """How much lower the relative error of kept-back pixels is with an effect than without; for lobe
    sampling, how much less of a pixel is noise.

    Args:
        model: its surface, and what it sends (R), are taken as they are; its material and its light play no
            part.
        pixels: of the training views.
        position, normal: points on the surface, scene frame; the first `PLACES` are taken.
        names: of `JUDGED`, what to judge.

    Returns:
        A measurement for each name, of no samples where views show too little.
    """
    places = gather_places(model, pixels, position[:PLACES], normal[:PLACES], VIEWS).in_views(MIN_VIEWS)
    if not len(places.place):
        return {name: Measurement("views of the same place", 0.0, 0.0, WORTH, 0) for name in names}
    transport = place_transport(places, LOBES[model.config.shading.lobe], model.scene)
    judged = judge_material(places, transport, model.facts.median_radiance, names)
    if "lobe-sampling" in names:
        judged.measured["lobe-sampling"] = lobe_noise(model, places, judged.glossy)
    return judged.measured


def seconds_of_evidence(device: torch.device) -> float:
    """Estimate how long one look at places takes here, if all of them are seen by many views.

    It is the time of the light's descents (`seconds_of_step`), and `REST` of that for all else.
    """
    step = seconds_of_step(PLACES * VIEWS * (FOLDS - 1) // FOLDS, device)
    return (1 + REST) * FITS * (FIRST_STEPS + (ROUNDS - 1) * STEPS) * step


@dataclass(frozen=True)
class Judged:
    """A measurement for each effect, and a fit with reflection."""

    measured: dict[str, Measurement]
    glossy: PlaceFit


@dataclass(frozen=True)
class Model:
    """What places may be made of.

    Attributes:
        reflects: whether they have a specular lobe.
        metals: whether metallic may be more than 0.
        roughness: of all, by its number in the grid; none: each has its own.
        form: of the map (`fit_places`).
    """

    reflects: bool = True
    metals: bool = False
    roughness: int | None = None
    form: Callable[[Tensor], Tensor] = any_map

    def sees(self, carried: Transport) -> Transport:
        """The transport with what such places have of it."""
        if not self.reflects:
            keeps = torch.zeros(len(carried.sources), 1, 1, device=carried.scene.device)
            keeps[0] = 1
            return Transport(carried.sources * keeps.half(), carried.scene * keeps)
        if self.roughness is None:
            return carried
        layers = [0] + [1 + 2 * self.roughness, 2 + 2 * self.roughness] * len(ROUGHNESSES)
        return Transport(carried.sources[layers], carried.scene[layers])


@dataclass(frozen=True)
class Explained:
    """A fit, its error at the pixels that it was fitted to, and that of each place in views that were kept
    back, NaN where none shows it.
    """

    fit: PlaceFit
    fitted_error: float
    error: Float[Tensor, " P"]


@dataclass(frozen=True)
class Trial:
    """Pixels that models are fitted to, and pixels of other views at which they are compared."""

    known: Places
    carried: Transport
    kept_back: Places
    carried_back: Transport
    typical: float

    def of(self, model: Model) -> Explained:
        """The places as a model explains them."""
        carried, typical = model.sees(self.carried), self.typical
        fit = fit_places(self.known, carried, typical, model.metals, form=model.form)
        if model.roughness is not None:
            fit = replace(fit, roughness=torch.full_like(fit.roughness, model.roughness))
        fitted = place_errors(fit, self.known, carried, typical).mean().item()
        error = self.kept_back.mean(place_errors(fit, self.kept_back, model.sees(self.carried_back), typical))
        seen = torch.bincount(self.kept_back.place, minlength=self.kept_back.count) > 0
        return Explained(fit, fitted, torch.where(seen, error, torch.nan))


@torch.no_grad()
def judge_material(places: Places, transport: Transport, typical: float, names: frozenset[str]) -> Judged:
    """What each of `names` saves at views that are kept back.

    Args:
        places: with linear radiance.
        transport: of the same pixels (`place_transport`).
        typical: radiance of a typical pixel.
        names: what to judge.
    """
    trials = []
    for turn in range(TURNS):
        back = places.view % FOLDS == turn
        known, kept_back = torch.nonzero(~back)[:, 0], torch.nonzero(back)[:, 0]
        parts = (places.where(known), transport[known], places.where(kept_back), transport[kept_back])
        trials.append(Trial(*parts, typical))
    measured: dict[str, Measurement] = {}

    def explained(model: Model) -> list[Explained]:
        return [trial.of(model) for trial in trials]

    paint = Model()
    of_paint, of_metal = explained(paint), explained(replace(paint, metals=True))
    counts = [_metallic(one.fit) > METAL for one in of_metal]
    measured["metals"] = _saved("metals", of_paint, of_metal, counts)
    metals = measured["metals"].favours(False) is True
    glossy, of_glossy = (replace(paint, metals=True), of_metal) if metals else (paint, of_paint)
    if "varying-roughness" in names:
        shared = min(SHARED, key=lambda number: trials[0].of(replace(glossy, roughness=number)).fitted_error)
        of_shared = explained(replace(glossy, roughness=shared))
        counts = [(one.fit.roughness - shared).abs() >= ANOTHER for one in of_glossy]
        measured["varying-roughness"] = _saved("varying-roughness", of_shared, of_glossy, counts)
    if "reflection" in names:
        measured["reflection"] = _saved("reflection", explained(Model(reflects=False)), of_glossy)
    for name, form in LIGHT_FORMS.items():
        if name in names:
            measured[name] = _saved(name, explained(replace(glossy, form=form)), of_glossy)
    return Judged({name: measured[name] for name in SAVED if name in names}, of_glossy[0].fit)


def _metallic(fit: PlaceFit) -> Float[Tensor, " P"]:
    return torch.tensor(METALLICS, device=fit.metallic.device)[fit.metallic]


def _saved(
    name: str,
    without: Sequence[Explained],
    having: Sequence[Explained],
    counts: Sequence[Bool[Tensor, " P"]] | None = None,
) -> Measurement:
    """How much lower the error is with something than without, at the places that count."""
    gains = [one.error - other.error for one, other in zip(without, having, strict=True)]
    if counts is not None:
        gains = [gain[counted] for gain, counted in zip(gains, counts, strict=True)]
    gain = torch.cat(gains)
    return mean_of(gain[gain.isfinite()], SAVED[name], WORTH)
