"""Make the light that the settings name: an environment map with lamps, or the paper's free light field."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor, nn

from neilfpp_method.fields.environment import EVEN_ROWS, EnvironmentLight
from neilfpp_method.fields.incident_light import IncidentLightField
from neilfpp_method.fields.lamps import Lamps
from neilfpp_method.settings.types import FreeLightConfig, MapLightConfig, NeilfConfig
from neilfpp_method.shading.sampling import Technique

__all__ = ["Light", "LightModel", "make_light"]

FREE_BASE = {"linear": 10.0, "srgb": math.e}
"""Base of the exponential at the output of a free field, by the response of the images (METHOD §5)."""
MAX_LAMPS = 8
"""Maximum number of lamps: more cannot be distinguished in photographs of one object."""
LAMP_RADIUS = 0.06
"""Radius of every lamp, scene units: a light bulb next to an object of 1 m. It determines how sharp the
reflections of lamps are.
"""


@runtime_checkable
class Light(Protocol):
    """Light that arrives at surface points without occlusion."""

    def radiance(self, x: Float[Tensor, "N 3"], wi: Float[Tensor, "N S 3"]) -> Float[Tensor, "N S 3"]:
        """Linear radiance > 0 that arrives at x from wi, which points away from x."""
        ...

    def technique(self, normal: Float[Tensor, "N 3"]) -> Technique | None:
        """Sampling of directions in proportion to the radiance times the cosine about a normal.

        Its density must be positive in all directions above the horizon. None if the light cannot be sampled.
        """
        ...


@dataclass(frozen=True)
class LightModel:
    """The light of a scene: `light`, distant or free at every point, and near `lamps` (possibly none)."""

    light: nn.Module
    lamps: Lamps

    def use(self, config: FreeLightConfig | MapLightConfig) -> None:
        """Switch to other settings. Whether an environment map is even may change; its size must not."""
        if isinstance(self.light, EnvironmentLight):
            self.light.set_even(config.environment_height == 1)


def make_light(config: NeilfConfig, response: str, initial_radiance: float) -> LightModel:
    """Make an untrained light with `initial_radiance` from all directions.

    Args:
        config: the settings.
        response: "linear" or "srgb"; it determines the output base of a free field.
        initial_radiance: initial linear radiance.
    """
    settings = config.light
    if isinstance(settings, FreeLightConfig):
        field = IncidentLightField(settings, config.encoding, FREE_BASE[response], initial_radiance)
        return LightModel(field, Lamps(0, LAMP_RADIUS))
    lamps = Lamps(0 if settings.kind == "distant" else MAX_LAMPS, LAMP_RADIUS)
    height = settings.environment_height
    environment = EnvironmentLight(EVEN_ROWS if height == 1 else height, initial_radiance)
    environment.set_even(height == 1)
    return LightModel(environment, lamps)
