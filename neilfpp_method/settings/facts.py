"""What the images of a capture decide before training, and the units that radiance is compared in."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from neilfpp_method.settings.types import NeilfConfig
from neilfpp_method.shading.color import apply_response, response_slope

__all__ = ["RadianceUnits", "SceneFacts", "radiance_units"]


@dataclass(frozen=True)
class SceneFacts:
    """What the images of a capture decide before training.

    Attributes:
        response: "linear" (HDR) or "srgb" (LDR): what a pixel is of radiance.
        median_radiance: median linear luminance of the object's pixels; the first render matches it.
        radiance_scale: the largest radiance that R can reach.
        background: "none", "constant" or "inverted_sphere".
        background_color: linear RGB of a constant background, and what an inverted sphere starts as.
        far_points: points of the scene reach far beyond its box, to walls and trees: what lies behind has a
            shape.
        log_gains: natural logarithms of how much brighter the training views are than their mean, red, green
            and blue of view after view; none: all are exposed alike.
    """

    response: str
    median_radiance: float
    radiance_scale: float
    background: str
    background_color: tuple[float, float, float] = (0.0, 0.0, 0.0)
    far_points: bool = False
    log_gains: tuple[float, ...] = ()


@dataclass(frozen=True)
class RadianceUnits:
    """Units of the losses on radiance, each in those that it compares (METHOD §4, last line)."""

    volume: float
    physical: float
    incident: float


def radiance_units(config: NeilfConfig, facts: SceneFacts) -> RadianceUnits:
    """The units that `config.loss.unit` names.

    "median": an error of as much as the median radiance is 1, whether the camera stores radiance or display
    values. The sRGB curve halves all contrasts; in units of the pixel, what speaks against noise would count
    twice as much.
    """
    if config.loss.unit == "activation":
        return RadianceUnits(facts.radiance_scale, 1.0, 1.0)
    pixel = apply_response(torch.tensor(facts.median_radiance), facts.response)
    unit = response_slope(pixel, facts.response).item()
    return RadianceUnits(unit, unit, facts.median_radiance)
