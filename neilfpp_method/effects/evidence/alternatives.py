"""Compare ways to explain the same places, in views that none of them was fitted to.

All have the same mean base colour, at which the comparison does not depend on it (`unbounded_scale`).
"""

from __future__ import annotations

from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.effects.light_scale import unbounded_scale
from neilfpp_method.effects.measurement import Measurement, mean_reduction
from neilfpp_method.effects.places.data import PlaceData, place_transport
from neilfpp_method.effects.places.fit import Permitted, fit_places, mean_errors
from neilfpp_method.effects.places.gathering import Places
from neilfpp_method.settings.facts import SceneFacts
from neilfpp_method.shading import LOBES
from neilfpp_method.structures import SceneTracer

__all__ = ["Alternatives", "reduction"]

FOLDS = 4
"""Number of folds of the views; every fold is held back in turn. With only one of them, the standard error
would be as large as the increase of the error that metals cause in a scene without metal.
"""
ROUNDS = 3
"""Alternations of light and material in a fit: half of the usual number separate the alternatives as well."""


class Alternatives:
    """Ways to explain places, by the lobe of highlights and with or without metals; each is fitted once.

    Args:
        places: places in the training views, with linear radiance.
        scene: traces rays through the scene; None without inter-reflection.
        facts: what was measured in the images.
    """

    def __init__(self, places: Places, scene: SceneTracer | None, facts: SceneFacts) -> None:
        self.places, self.scene, self.facts = places, scene, facts
        self._data: dict[str, PlaceData] = {}
        self._errors: dict[tuple[str, bool], list[Tensor]] = {}

    def data(self, lobe: str) -> PlaceData:
        """The places, and the transport to their pixels with this lobe, a key of `LOBES`."""
        if lobe not in self._data:
            transport = place_transport(self.places, LOBES[lobe], self.scene)
            self._data[lobe] = PlaceData(
                self.places, transport, self.facts.median_radiance, self.facts.response
            )
        return self._data[lobe]

    @torch.no_grad()
    def errors(self, lobe: str, metals: bool) -> list[Float[Tensor, " P"]]:
        """The mean relative error of each place in each held-back fold of the views; NaN without pixels.

        Args:
            lobe: the lobe of highlights, a key of `LOBES`.
            metals: whether metallic may be greater than 0.
        """
        if (lobe, metals) not in self._errors:
            data = self.data(lobe)
            permitted = Permitted(metals, self._scale)
            splits = (data.hold_back(fold, FOLDS) for fold in range(FOLDS))
            self._errors[lobe, metals] = [
                mean_errors(fit_places(split.known, permitted, rounds=ROUNDS), split.held_back)
                for split in splits
            ]
        return self._errors[lobe, metals]

    @cached_property
    def _scale(self) -> float:
        """The mean base colour of all fits. It hardly depends on the lobe: the first one is used."""
        return unbounded_scale(next(iter(self._data.values())))


def reduction(
    simple: list[Float[Tensor, " P"]], rich: list[Float[Tensor, " P"]], by: str, threshold: float
) -> Measurement:
    """Mean reduction of the relative error of the places by the richer of two alternatives.

    Args:
        simple, rich: `Alternatives.errors` of the two.
        by: what distinguishes the richer alternative, for the description of the measurement.
        threshold: reduction above which the richer alternative is used.
    """
    turns = (before - after for before, after in zip(simple, rich, strict=True))
    return mean_reduction(turns, f"reduction of the error in held-back views by {by}", threshold)
