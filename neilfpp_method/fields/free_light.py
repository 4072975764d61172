"""The light field that is free at every point, by the network that the settings name."""

from __future__ import annotations

from neilfpp_method.config import IncidentLightConfig
from neilfpp_method.fields.factorised_light import FactorisedLightField
from neilfpp_method.fields.incident_light import IncidentLightField

__all__ = ["make_incident_light"]


def make_incident_light(
    config: IncidentLightConfig, base: float, initial_radiance: float
) -> IncidentLightField | FactorisedLightField:
    """A field of positive radiance that starts near `initial_radiance`; `base` is that of its exponential."""
    field = FactorisedLightField if config.network == "factorised" else IncidentLightField
    return field(config, base, initial_radiance)
