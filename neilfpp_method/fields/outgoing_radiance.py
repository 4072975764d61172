"""The outgoing radiance field R: position and direction → linear RGB (METHOD §5)."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn

from neilfpp_method.fields.encodings import Raw, direction_encoding, position_encoding
from neilfpp_method.fields.mlp import Mlp
from neilfpp_method.settings.types import FrequencyConfig, HashGridConfig, OutgoingRadianceConfig

__all__ = ["MID_GRAY", "OutgoingRadianceField"]

MID_GRAY = 0.2
"""Default initial radiance: about 18 % grey, the mean of a well-exposed photograph."""
DIRECTION_OCTAVES, DIRECTION_BANDS = 4, 4
"""Octaves or bands of the encoding of directions (NeILF++ §5)."""


class OutgoingRadianceField(nn.Module):
    """A network whose output is a sigmoid times the largest radiance.

    With `config.positions = "raw"` positions are not encoded here: the feature of G encodes them (NeILF++
    §5).

    Args:
        config: the settings of R.
        encoding: encoding of positions, which also determines that of the directions.
        feature_width: length of the feature vector of G; 0 if there is none.
        radius: radius of the scene sphere, scene units.
        scale: largest radiance.
        start: initial radiance; values above scale/2 count as scale/2.
    """

    def __init__(
        self,
        config: OutgoingRadianceConfig,
        encoding: FrequencyConfig | HashGridConfig,
        feature_width: int,
        radius: float,
        scale: float,
        start: float = MID_GRAY,
    ) -> None:
        super().__init__()
        self.scale = scale
        self.mirrored = config.direction == "mirrored"
        waves = isinstance(encoding, FrequencyConfig)
        self.position = (
            Raw() if config.positions == "raw" and feature_width else position_encoding(encoding, radius)
        )
        self.direction = direction_encoding(
            "frequency" if waves else "spherical_harmonics", DIRECTION_OCTAVES, DIRECTION_BANDS
        )
        inputs = self.position.width + self.direction.width + self.mirrored + 3 + feature_width
        self.mlp = Mlp(inputs, 3, config.layers, config.width, "relu", output_scale=0.1)
        share = min(start / scale, 0.5)
        nn.init.constant_(self.mlp.layers[-1].bias, math.log(share / (1 - share)))

    def forward(
        self,
        x: Float[Tensor, "N 3"],
        wo: Float[Tensor, "N 3"],
        normal: Float[Tensor, "N 3"],
        feature: Float[Tensor, "N F"],
    ) -> Float[Tensor, "N 3"]:
        """Radiance that leaves x towards wo, given the normal and the feature vector of G at x."""
        inputs = torch.cat((self.position(x), *self._directions(wo, normal), normal, feature), -1)
        return self.scale * torch.sigmoid(self.mlp(inputs))

    def _directions(self, wo: Float[Tensor, "N 3"], normal: Float[Tensor, "N 3"]) -> tuple[Tensor, ...]:
        """The encoded direction, and n·wo beside a mirrored one, for the Fresnel effect (Ref-NeRF §3)."""
        if not self.mirrored:
            return (self.direction(wo),)
        cosine = (normal * wo).sum(-1, keepdim=True)
        return self.direction(2 * cosine * normal - wo), cosine
