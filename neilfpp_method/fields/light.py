"""Which light the settings ask for: an environment map with lamps before it, or the paper's free field."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor, nn

from neilfpp_method.fields.environment import EVEN_ROWS, EnvironmentLight
from neilfpp_method.fields.incident_light import IncidentLightField
from neilfpp_method.fields.lamps import Lamps
from neilfpp_method.settings.types import FreeLightConfig, NeilfConfig
from neilfpp_method.shading.sampling import Technique

__all__ = ["Light", "LightModel", "make_light"]

FREE_BASE = {"linear": 10.0, "srgb": math.e}
"""Base of the exponential at the end of a free field, by what the pixels are (METHOD §5)."""
MAX_LAMPS = 8
"""Lamps close by: more than photographs of one object tell apart."""
LAMP_RADIUS = 0.06
"""Of every lamp, scene units: a bulb beside a 1 m object. It decides how sharp its reflections are."""


@runtime_checkable
class Light(Protocol):
    """What arrives at surface points when nothing stands in the way."""

    def radiance(self, x: Float[Tensor, "N 3"], wi: Float[Tensor, "N S 3"]) -> Float[Tensor, "N S 3"]:
        """Linear radiance > 0 that arrives at x from wi, which points away from x."""
        ...

    def technique(self, normal: Float[Tensor, "N 3"]) -> Technique | None:
        """A way to draw directions in proportion to the radiance; none for a light that cannot be sampled."""
        ...


@dataclass(frozen=True)
class LightModel:
    """The light of a scene: `light`, distant or free at every point, and near `lamps`, perhaps none."""

    light: nn.Module
    lamps: Lamps


def make_light(config: NeilfConfig, response: str, initial_radiance: float) -> LightModel:
    """An untrained light that sends `initial_radiance` from everywhere; `response` is "linear" or "srgb"."""
    settings = config.light
    if isinstance(settings, FreeLightConfig):
        field = IncidentLightField(settings, config.encoding, FREE_BASE[response], initial_radiance)
        return LightModel(field, Lamps(0, LAMP_RADIUS))
    lamps = Lamps(0 if settings.kind == "distant" else MAX_LAMPS, LAMP_RADIUS)
    height = settings.environment_height
    environment = EnvironmentLight(EVEN_ROWS if height == 1 else height, initial_radiance)
    environment.be_even(height == 1)
    return LightModel(environment, lamps)
