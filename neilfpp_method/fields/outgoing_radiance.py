"""R: what the scene sends out, position and direction → linear RGB (METHOD §5)."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn

from neilfpp_method.fields.encodings import Raw, direction_encoding, position_encoding
from neilfpp_method.fields.mlp import Mlp
from neilfpp_method.settings.types import FrequencyConfig, HashGridConfig, OutgoingRadianceConfig

__all__ = ["MID_GREY", "OutgoingRadianceField"]

MID_GREY = 0.2
DIRECTION_OCTAVES, DIRECTION_BANDS = 4, 4
"""Of the encoding of directions (NeILF++ §5)."""


class OutgoingRadianceField(nn.Module):
    """A sigmoid times `scale`, the largest radiance; starts near the radiance `start`, at most scale/2.

    Positions may enter raw (`config.positions`) beside a feature of G, which encodes them (NeILF++ §5).
    """

    def __init__(
        self,
        config: OutgoingRadianceConfig,
        encoding: FrequencyConfig | HashGridConfig,
        feature_width: int,
        radius: float,
        scale: float,
        start: float = MID_GREY,
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
        """Radiance that leaves x towards wo; `normal` and `feature` are those of the distance field at x."""
        inputs = torch.cat((self.position(x), *self._directions(wo, normal), normal, feature), -1)
        return self.scale * torch.sigmoid(self.mlp(inputs))

    def _directions(self, wo: Float[Tensor, "N 3"], normal: Float[Tensor, "N 3"]) -> tuple[Tensor, ...]:
        """The encoded direction; a mirrored one with n·wo, for Fresnel's sake (Ref-NeRF §3)."""
        if not self.mirrored:
            return (self.direction(wo),)
        cosine = (normal * wo).sum(-1, keepdim=True)
        return self.direction(2 * cosine * normal - wo), cosine
