"""Evidence for metals: places fitted as metal and as paint, compared on views kept back.

A dark gloss under a bright light explains a single view of a metal, and a metal explains a single view of a
paint. How a place changes from view to view tells them apart. So light and materials are fitted to most views
with and without metals, and compared at pixels of the other views. Only places count that the fit with metals
takes for metal: at the others the two fits hardly differ. Lamps are no part of these fits.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.data.pixels import PixelDataset
from neilfpp_method.effects.measurement import Measurement, mean_of
from neilfpp_method.effects.place_fit import METALLICS, fit_places, place_errors, place_transport
from neilfpp_method.effects.places import gather_places
from neilfpp_method.model import NeilfModel

__all__ = ["metal_evidence"]

PLACES, VIEWS = 160, 20
"""How many places, and of each at most so many views: seconds, and 300 MB, on a laptop."""
FOLDS, TURNS = 4, 2
"""Of the views one in four is kept back, in two of the four possible ways."""
MIN_VIEWS = 4
"""Views that must show a place: fewer do not tell materials apart."""
WORTH = 0.01
"""Relative error that metals must save at the places that are taken for metal."""
METAL = 0.5
"""Metallic above which a place is taken for metal."""


@torch.no_grad()
def metal_evidence(
    model: NeilfModel, pixels: PixelDataset, position: Float[Tensor, "P 3"], normal: Float[Tensor, "P 3"]
) -> Measurement:
    """How much lower metals make the relative error of kept-back pixels, at places taken for metal.

    Args:
        model: its surface, and what it sends (R), are taken as they are; its material and its light play no
            part.
        pixels: of the training views.
        position, normal: points on the surface, scene frame; the first `PLACES` are taken.
    """
    what = "error that metals save in views kept back, at places taken for metal"
    if model.lobe is None:
        return Measurement(what, 0.0, 0.0, WORTH, 0)
    places = gather_places(model, pixels, position[:PLACES], normal[:PLACES], VIEWS).in_views(MIN_VIEWS)
    if not len(places.place):
        return Measurement(what, 0.0, 0.0, WORTH, 0)
    transport = place_transport(places, model.lobe, model.scene)
    typical = model.facts.median_radiance
    gains = []
    for turn in range(TURNS):
        back = places.view % FOLDS == turn
        fitted, kept_back = torch.nonzero(~back)[:, 0], torch.nonzero(back)[:, 0]
        known, unknown = places.where(fitted), places.where(kept_back)
        paint, metal = (fit_places(known, transport[fitted], typical, metals) for metals in (False, True))
        carried = transport[kept_back]
        gain = place_errors(paint, unknown, carried, typical) - place_errors(metal, unknown, carried, typical)
        counts = (torch.bincount(unknown.place, minlength=places.count) > 0) & (
            metal.metallic >= _first_metal()
        )
        gains.append(unknown.mean(gain)[counts])
    return mean_of(torch.cat(gains), what, WORTH)


def _first_metal() -> int:
    return next(i for i, metallic in enumerate(METALLICS) if metallic > METAL)
