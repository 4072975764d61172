"""Facts about a capture that are measured before training, and the units in which losses measure radiance."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from neilfpp_method.errors import UserError
from neilfpp_method.settings.types import NeilfConfig
from neilfpp_method.shading.color import apply_response, response_slope

__all__ = ["RadianceUnits", "SceneFacts", "radiance_units", "stated_facts"]

RADIANCE_SCALE = {"linear": 3.0, "srgb": 1.0}
"""Largest radiance of R by kind of image, HDR and LDR (METHOD §5)."""


@dataclass(frozen=True)
class SceneFacts:
    """Facts about a capture that are measured on its images before training.

    Attributes:
        response: meaning of pixel values: "linear" (HDR radiance) or "srgb" (LDR display values).
        median_radiance: median linear luminance of the object's pixels; the first render matches it.
        radiance_scale: largest radiance that R can represent.
        background: "none", "constant" or "inverted_sphere".
        background_color: linear RGB of a constant background, and initial colour of an inverted sphere.
        far_points: whether points of the scene reach far beyond its box, to walls and trees, so that the
            background has a shape.
        log_gains: natural logarithms of the gains of the training views relative to their mean, as red,
            green, blue of one view after the other; empty if all views have the same exposure.
    """

    response: str
    median_radiance: float
    radiance_scale: float
    background: str
    background_color: tuple[float, float, float] = (0.0, 0.0, 0.0)
    far_points: bool = False
    log_gains: tuple[float, ...] = ()


def stated_facts(
    response: str, median_radiance: float, radiance_scale: float | None, open_scene: bool
) -> SceneFacts:
    """The facts about images that are not at hand; see `attach.attach_neilf` for the arguments.

    Raises:
        UserError: an argument is out of range.

    Example:
        >>> stated_facts("srgb", 0.2, None, open_scene=False).radiance_scale
        1.0
    """
    if response not in RADIANCE_SCALE:
        raise UserError(
            f"response '{response}'",
            "choose linear (pixels are radiance) or srgb (8-bit images, divided by 255)",
        )
    scale = RADIANCE_SCALE[response] if radiance_scale is None else radiance_scale
    if not 0 < median_radiance < math.inf:
        raise UserError(
            f"median_radiance is {median_radiance}", "give the median linear luminance of the object, above 0"
        )
    if not 0 < scale < math.inf:
        raise UserError(f"radiance_scale is {scale}", "give the largest radiance of the host, above 0")
    return SceneFacts(response, median_radiance, scale, "inverted_sphere" if open_scene else "constant")


@dataclass(frozen=True)
class RadianceUnits:
    """The value by which each loss on radiance is divided (METHOD §4, last line).

    Attributes:
        volume: unit of L_vol, in pixel values.
        physical: unit of L_phys, in pixel values.
        incident: unit of L_ref, in linear radiance.
    """

    volume: float
    physical: float
    incident: float


def radiance_units(config: NeilfConfig, facts: SceneFacts) -> RadianceUnits:
    """The units for `config.loss.unit`.

    "activation" divides L_vol by the range of R's output. "median" makes a relative error of radiance count
    the same for linear and sRGB pixels: the unit of a pixel is its change per unit of log radiance at the
    median. The sRGB curve halves contrasts, so in units of the pixel value the regularisers would weigh twice
    as much.
    """
    if config.loss.unit == "activation":
        return RadianceUnits(facts.radiance_scale, 1.0, 1.0)
    pixel = apply_response(torch.tensor(facts.median_radiance), facts.response)
    unit = response_slope(pixel, facts.response).item()
    return RadianceUnits(unit, unit, facts.median_radiance)
