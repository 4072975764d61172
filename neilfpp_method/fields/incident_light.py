"""L: the incident light field, position and direction → linear RGB that arrives (METHOD §5).

Light is sharp in direction and smooth in position. So the direction enters encoded, at the first and at the
middle layer, and the position raw, at the middle layer only.
"""

from __future__ import annotations

import math

from jaxtyping import Float
from torch import Tensor, nn

from neilfpp_method.fields.encodings import direction_encoding
from neilfpp_method.fields.mlp import Mlp
from neilfpp_method.settings.types import FreeLightConfig, FrequencyConfig, HashGridConfig

__all__ = ["IncidentLightField", "exponential"]


MAX_EXPONENT = 20.0  # radiance stays within e^±20 of its start
DIRECTION_OCTAVES, DIRECTION_BANDS = 6, 5
"""Of the encoding of directions: light is sharper in direction than what surfaces send (NeILF++ §5)."""


class IncidentLightField(nn.Module):
    """radiance = initial_radiance · base^output. The outputs start near 0.

    Beside a frequency encoding of positions directions are encoded by frequencies too, beside a hash grid by
    spherical harmonics, as in R (NeILF++ §5).

    The middle layer is linear in what it sees, so the share of the direction and the share of the position
    are computed apart and added: the position costs one small product per point, and the directions can be
    shared between points.
    """

    def __init__(
        self,
        config: FreeLightConfig,
        encoding: FrequencyConfig | HashGridConfig,
        base: float,
        initial_radiance: float,
    ) -> None:
        super().__init__()
        self.log_base = math.log(base)
        self.initial_radiance = initial_radiance
        self.direction = direction_encoding(
            "frequency" if isinstance(encoding, FrequencyConfig) else "spherical_harmonics",
            DIRECTION_OCTAVES,
            DIRECTION_BANDS,
        )
        middle, width = config.layers // 2, config.width
        self.direction_part = Mlp(self.direction.width, width, middle, width, config.activation, skip=middle)
        self.position_part = nn.Linear(3, width, bias=False)
        outputs = 1 if config.monochrome else 3
        self.tail = Mlp(
            width, outputs, config.layers - middle - 1, width, config.activation, output_scale=0.1
        )
        nn.init.zeros_(self.tail.layers[-1].bias)
        # Position and direction meet in one layer, so its weights start alike; those of the tail as well.
        bound = self.direction_part.layers[-1].weight.abs().max().item()
        nn.init.uniform_(self.position_part.weight, -bound, bound)
        self.tail.activation.init_(self.tail.layers[0])

    def radiance(self, x: Float[Tensor, "N 3"], wi: Float[Tensor, "#N S 3"]) -> Float[Tensor, "N S 3"]:
        """Radiance > 0 that arrives at x from wi, which points away from x.

        Directions that all points share, (1, S, 3), go through their part of the network once.
        """
        directions = self.direction_part(self.direction(wi))
        middle = directions + self.position_part(x)[:, None]
        return exponential(
            self.log_base * self.tail(self.tail.activation.value(middle)), self.initial_radiance
        )

    def technique(self, normal: Float[Tensor, "N 3"]) -> None:
        """None: a network cannot be sampled."""
        return None


def exponential(exponent: Float[Tensor, "*B C"], initial_radiance: float) -> Float[Tensor, "*B 3"]:
    """initial_radiance · e^exponent, one channel for all three colours where there is one.

    The exponent is clamped, with derivative 1 everywhere: a value beyond the limit still feels the loss.
    """
    limited = exponent.clamp(-MAX_EXPONENT, MAX_EXPONENT).detach() + (exponent - exponent.detach())
    return (initial_radiance * limited.exp()).expand(*exponent.shape[:-1], 3)
