"""Which light the settings ask for: an environment map with lamps before it, or the paper's free field."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor, nn

from neilfpp_method.fields.environment import EnvironmentLight
from neilfpp_method.fields.incident_light import IncidentLightField
from neilfpp_method.fields.lamps import Lamps
from neilfpp_method.settings.types import IncidentLightConfig
from neilfpp_method.shading.sampling import Technique

__all__ = ["Light", "LightModel", "make_light"]

FREE_BASE = {"linear": 10.0, "srgb": math.e}
"""Base of the exponential at the end of a free field, by what the pixels are (METHOD §5)."""


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
    """The light of a scene: `light` from far away or free at every point, and `lamps` close by, perhaps none."""

    light: nn.Module
    lamps: Lamps


def make_light(config: IncidentLightConfig, response: str, initial_radiance: float) -> LightModel:
    """An untrained light that sends `initial_radiance` from everywhere; `response` is "linear" or "srgb"."""
    if config.kind == "free":
        base = config.base or FREE_BASE[response]
        return LightModel(IncidentLightField(config, base, initial_radiance), Lamps(0, config.fit.lamp_radius))
    lamps = 0 if config.kind == "distant" else config.fit.lamps
    return LightModel(EnvironmentLight(config.environment_height, initial_radiance), Lamps(lamps, config.fit.lamp_radius))
