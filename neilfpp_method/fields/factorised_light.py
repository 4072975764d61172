"""L in factors: L(x, ω) = L₀ · base^⟨f_c(x), g(ω)⟩ for each colour channel c, a light field whose pairs cost a dot product.

g is a map over the directions with `rank` values a texel, f a small network of the position with `rank` values a channel:
the light is a geometric mean of `rank` environment maps with exponents that vary from place to place. Neither is asked for a
pair of a point and a direction. Directions that points share make all pairs together one matrix product.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from neilfpp_method.config import IncidentLightConfig
from neilfpp_method.fields.direction_map import interpolate
from neilfpp_method.fields.encodings import FrequencyEncoding
from neilfpp_method.fields.incident_light import exponential
from neilfpp_method.fields.mlp import Mlp

__all__ = ["FactorisedLightField"]

POSITION_OCTAVES = 2  # light is smooth in position
POSITION_LAYERS = 3
FIRST_MAP = 0.05  # standard deviation of g at the start


class FactorisedLightField(nn.Module):
    """radiance = initial_radiance · base^⟨f(x), g(wi)⟩. The exponents start near 0.

    Interface and start are those of `IncidentLightField`; `monochrome` gives the three channels one f.
    """

    def __init__(self, config: IncidentLightConfig, base: float, initial_radiance: float) -> None:
        super().__init__()
        self.log_base = math.log(base)
        self.initial_radiance = initial_radiance
        self.rank, self.channels = config.rank, 1 if config.monochrome else 3
        self.position = FrequencyEncoding(POSITION_OCTAVES)
        outputs = self.channels * self.rank
        self.position_part = Mlp(self.position.width, outputs, POSITION_LAYERS, config.width, "relu")
        height = config.environment_height
        self.direction_map = nn.Parameter(FIRST_MAP * torch.randn(self.rank, height, 2 * height))

    def radiance(
        self,
        x: Float[Tensor, "N 3"],
        wi: Float[Tensor, "S 3"] | Float[Tensor, "#N S 3"],
        asked: Bool[Tensor, "N S"] | None = None,
    ) -> Float[Tensor, "N S 3"]:
        """Radiance > 0 that arrives at x from wi, which points away from x.

        Directions that all points share come as (S, 3) or (1, S, 3). All pairs are computed, `asked` or not: choosing
        would cost more than it saves.
        """
        factors = self.position_part(self.position(x)).unflatten(1, (self.channels, self.rank))
        directions = interpolate(self.direction_map, wi if wi.ndim == 3 else wi[None])
        if len(directions) == 1:
            exponent = (factors.flatten(0, 1) @ directions[0].T).unflatten(0, (-1, self.channels)).transpose(1, 2)
        else:
            exponent = directions @ factors.transpose(1, 2)
        return exponential(self.log_base * exponent, self.initial_radiance)
