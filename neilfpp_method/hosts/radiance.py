"""The fields of radiance of this package's hosts: R on surfaces, and the background behind them."""

from __future__ import annotations

import torch

from neilfpp_method.fields.background import InvertedSphere
from neilfpp_method.fields.outgoing_radiance import OutgoingRadianceField
from neilfpp_method.settings.facts import SceneFacts
from neilfpp_method.settings.types import NeilfConfig

__all__ = ["background_field", "radiance_field"]


def radiance_field(config: NeilfConfig, facts: SceneFacts, feature_width: int) -> OutgoingRadianceField:
    """Make R with the range and the initial value of a scene; G has `feature_width` features, or none."""
    scale, start = facts.radiance_scale, facts.median_radiance
    return OutgoingRadianceField(
        config.radiance, config.encoding, feature_width, config.background.radius, scale, start
    )


def background_field(config: NeilfConfig, facts: SceneFacts) -> InvertedSphere | None:
    """Make the field of the background of a scene; None if the background is constant or missing."""
    if facts.background != "inverted_sphere":
        return None
    scale, start = facts.radiance_scale, torch.tensor(facts.background_color)
    return InvertedSphere(config.background, config.encoding, scale, start)
