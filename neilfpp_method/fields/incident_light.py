"""The incident light field L of the paper: position and direction → incident linear RGB (METHOD §5).

Incident light is sharp in direction and smooth in position. So the encoded direction enters at the first and
the middle layer, and the plain position at the middle layer only.
"""

from __future__ import annotations

import math

from jaxtyping import Float
from torch import Tensor, nn

from neilfpp_method.fields.encodings import direction_encoding
from neilfpp_method.fields.mlp import Mlp
from neilfpp_method.settings.types import FreeLightConfig, FrequencyConfig, HashGridConfig

__all__ = ["IncidentLightField", "exponential"]


MAX_EXPONENT = 20.0
"""Bound on the log of radiance relative to the initial radiance, against overflow."""
DIRECTION_OCTAVES, DIRECTION_BANDS = 6, 5
"""Octaves or bands of the encoding of directions: more than in R, as L is sharper (NeILF++ §5)."""


class IncidentLightField(nn.Module):
    """A network with radiance = initial_radiance · base^output, whose outputs start near 0.

    As in R, directions are encoded by frequencies if `encoding` is the frequency encoding, and by spherical
    harmonics if it is the hash grid (NeILF++ §5).

    The pre-activation of the middle layer is a sum of a term of the direction and a term of the position. The
    two are computed separately: the position costs one small product per point, and directions that points
    share are evaluated once.

    Args:
        config: the settings of the free light.
        encoding: encoding of positions of the other fields, which determines that of the directions.
        base: base of the exponential (METHOD §5).
        initial_radiance: initial radiance from all directions.
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
        # The position's weights belong to the same layer as those of the direction: same initial range. The
        # first layer of the tail is a hidden layer, not an input layer, of the whole network.
        bound = self.direction_part.layers[-1].weight.abs().max().item()
        nn.init.uniform_(self.position_part.weight, -bound, bound)
        self.tail.activation.init_(self.tail.layers[0])

    def radiance(self, x: Float[Tensor, "N 3"], wi: Float[Tensor, "#N S 3"]) -> Float[Tensor, "N S 3"]:
        """Radiance > 0 that arrives at x from wi, which points away from x.

        Directions of shape (1, S, 3), which all points share, are evaluated once.
        """
        directions = self.direction_part(self.direction(wi))
        middle = directions + self.position_part(x)[:, None]
        return exponential(
            self.log_base * self.tail(self.tail.activation.value(middle)), self.initial_radiance
        )

    def technique(self, normal: Float[Tensor, "N 3"]) -> None:
        """Return None: a network cannot be importance-sampled."""
        return None


def exponential(exponent: Float[Tensor, "*B C"], initial_radiance: float) -> Float[Tensor, "*B 3"]:
    """initial_radiance · e^exponent; a single channel is copied to all three colours.

    The exponent is clamped, but its derivative is 1 everywhere, so that values beyond the limit can return.
    """
    limited = exponent.clamp(-MAX_EXPONENT, MAX_EXPONENT).detach() + (exponent - exponent.detach())
    return (initial_radiance * limited.exp()).expand(*exponent.shape[:-1], 3)
