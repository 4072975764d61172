"""The BRDF field B: position → base colour, roughness, metallic (METHOD §5)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from neilfpp_method.fields.encodings import position_encoding, pull_back
from neilfpp_method.fields.mlp import Mlp, middle_skip
from neilfpp_method.settings.types import BrdfConfig, FrequencyConfig, HashGridConfig
from neilfpp_method.structures import Material

__all__ = ["BrdfField", "BrdfSample"]

START_RANGE = (0.05, 0.95)
"""Range of initial parameters in `start_at`: at 0 and 1 the tanh has no gradient."""


@dataclass(frozen=True)
class BrdfSample:
    """The material at N points, and the spatial gradients of roughness and metallic, per scene unit."""

    material: Material
    roughness_gradient: Float[Tensor, "N 3"]
    metallic_gradient: Float[Tensor, "N 3"]


class BrdfField(nn.Module):
    """Network of position whose outputs y give the material parameters as ½ + ½ tanh(y).

    Roughness starts near ½; base colour and metallic start as the settings say. Without `metals`, metallic is
    0 everywhere and has no gradient. Without `varying_roughness`, roughness is the same everywhere and is
    learned as the bias of its output; it keeps this value if it is later allowed to vary. Base colour is
    multiplied by a factor, which is 1 during training (`scale_base_color`).

    Args:
        config: the settings of B.
        encoding: encoding of positions.
        radius: radius of the scene sphere, scene units.
    """

    def __init__(self, config: BrdfConfig, encoding: FrequencyConfig | HashGridConfig, radius: float) -> None:
        super().__init__()
        self.use(config)
        self.base_color_scale: Tensor
        self.register_buffer("base_color_scale", torch.ones(()))
        self.encoding = position_encoding(encoding, radius)
        # Sine layers add the detail that a frequency encoding of six octaves lacks (NeILF++ §5).
        activation = "sine" if isinstance(encoding, FrequencyConfig) else "relu"
        skip = middle_skip(config.layers)
        self.mlp = Mlp(
            self.encoding.width, 5, config.layers, config.width, activation, skip=skip, output_scale=1e-2
        )
        nn.init.zeros_(self.mlp.layers[-1].bias)
        with torch.no_grad():
            self.mlp.layers[-1].bias[:3] = math.atanh(2 * config.initial_base_color - 1)
            self.mlp.layers[-1].bias[4] = math.atanh(2 * config.initial_metallic - 1)

    def use(self, config: BrdfConfig) -> None:
        """Switch metals and varying roughness on or off."""
        self.metals, self.varying_roughness = config.metals, config.varying_roughness

    def forward(self, x: Float[Tensor, "N 3"]) -> Material:
        """The material at points of the scene frame."""
        return self._material(torch.tanh(self.mlp(self.encoding(x))))

    def with_gradients(self, x: Float[Tensor, "N 3"]) -> BrdfSample:
        """The material with gradients of roughness and metallic; losses on them need first-order autograd."""
        encoded = self.encoding.with_jacobian(x)
        sample = self.mlp.with_gradient(encoded.features, slice(3, 5))
        saturation = torch.tanh(sample.value)
        slope = 0.5 * (1 - saturation[:, 3:].square())
        roughness, metallic = (slope[..., None] * pull_back(sample.gradient, encoded)).unbind(1)
        return BrdfSample(
            self._material(saturation),
            roughness if self.varying_roughness else torch.zeros_like(roughness),
            metallic if self.metals else torch.zeros_like(metallic),
        )

    @torch.no_grad()
    def start_at(self, material: Material) -> None:
        """Set the output biases so that an untrained field has this material (N = 1) everywhere."""
        values = torch.cat((material.base_color, material.roughness, material.metallic), -1)[0]
        self.mlp.layers[-1].bias.copy_(torch.atanh(2 * values.clamp(*START_RANGE) - 1))

    @torch.no_grad()
    def brighten(self, base_color: float, factor: float) -> None:
        """Shift the biases so that this base colour becomes brighter by a factor.

        Darker ones are multiplied by about the same factor. Brighter ones approach 1. All keep a gradient, so
        the field can be trained further.
        """
        before, after = (min(value, START_RANGE[1]) for value in (base_color, factor * base_color))
        shift = math.atanh(2 * after - 1) - math.atanh(2 * before - 1)
        self.mlp.layers[-1].bias[:3] += shift

    @torch.no_grad()
    def scale_base_color(self, factor: float) -> None:
        """Multiply all base colours by a factor, up to 1, where they have no gradient any more."""
        self.base_color_scale *= factor

    def _material(self, saturation: Float[Tensor, "N 5"]) -> Material:
        base_color, roughness, metallic = (0.5 + 0.5 * saturation).split((3, 1, 1), -1)
        base_color = (self.base_color_scale * base_color).clamp_max(1.0)
        if not self.varying_roughness:
            roughness = (0.5 + 0.5 * torch.tanh(self.mlp.layers[-1].bias[3:4])).expand_as(roughness)
        return Material(base_color, roughness, metallic if self.metals else torch.zeros_like(metallic))
