"""Radiance beyond the scene sphere: an inverted-sphere radiance field (NeRF++, Zhang et al. 2020, §4).

With frequency encodings the field is that of NeRF++. With a hash grid, the space beyond the sphere is
contracted into a shell (mip-NeRF 360, Barron et al. 2022, eq. 10), and a grid of that shell encodes
positions. It learns the background as fast as the grids of G and R learn the scene; while the background is
unknown, density in front of the cameras explains it.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from neilfpp_method.fields.encodings import FrequencyEncoding, HashGrid, position_encoding
from neilfpp_method.fields.mlp import Mlp
from neilfpp_method.settings.types import BackgroundConfig, FrequencyConfig, HashGridConfig
from neilfpp_method.volume.compositing import composite, render_weights

__all__ = ["InvertedSphere"]

POSITION_OCTAVES, DIRECTION_OCTAVES = 10, 4
"""Octaves of the frequency encodings of positions and directions (NeRF++)."""
FREQUENCY_LAYERS, FREQUENCY_WIDTH = 8, 256
"""Hidden layers and their units with frequency encodings (NeRF++)."""
HASH_LAYERS, HASH_WIDTH = 2, 64
"""The same with a hash grid (published code): the grid represents detail, so a small network is enough."""
SHELL_RADIUS = 2.0
"""Outer radius of the shell into which the space beyond the sphere is contracted; the inner one is 1."""
MIN_START = 1e-2
"""Smallest distance of the initial radiance from both ends of the sigmoid's range, relative to the range."""
START_SCALE = 1e-3
"""Factor on the initial weights of the last layer, so that the field starts as an almost constant colour."""


class InvertedSphere(nn.Module):
    """Radiance field outside of the scene sphere in the coordinates (x/r, 1/r), r the distance to the origin.

    Density is per unit of 1/r. Samples are the midpoints of equal steps of 1/r from the sphere to infinity.
    Light that passes all samples has the colour of the last one.

    Args:
        config: the settings.
        encoding: kind and sizes of the position encoding.
        scale: largest radiance.
        start: initial linear RGB, the same in all directions; if None, half of the largest radiance.
    """

    def __init__(
        self,
        config: BackgroundConfig,
        encoding: FrequencyConfig | HashGridConfig,
        scale: float,
        start: Float[Tensor, " 3"] | None = None,
    ) -> None:
        super().__init__()
        self.radius = config.radius
        self.scale = scale
        self.samples = config.samples
        if isinstance(encoding, FrequencyConfig):
            self.position = FrequencyEncoding(POSITION_OCTAVES, dimensions=4)
            layers, width = FREQUENCY_LAYERS, FREQUENCY_WIDTH
        else:
            self.position = position_encoding(encoding, SHELL_RADIUS)
            layers, width = HASH_LAYERS, HASH_WIDTH
        self.direction = FrequencyEncoding(DIRECTION_OCTAVES)
        self.trunk = Mlp(self.position.width, 1 + width, layers, width, "relu", skip=layers // 2)
        self.head = Mlp(width + self.direction.width, 3, 1, width // 2, "relu", output_scale=START_SCALE)
        if start is not None:
            with torch.no_grad():
                self.head.layers[-1].bias.copy_(torch.logit(start / scale, eps=MIN_START))

    def forward(
        self, origins: Float[Tensor, "N 3"], directions: Float[Tensor, "N 3"]
    ) -> Float[Tensor, "N 3"]:
        """Radiance in [0, scale] that enters the sphere along each ray from outside.

        Args:
            origins: ray origins inside the sphere.
            directions: unit ray directions.
        """
        inverse = self._inverse_radii(origins)
        points = _on_sphere(origins, directions, 1 / inverse)
        trunk = self.trunk(self._encoded(points, inverse))
        # Scaled by the radius, as 1/r spans [0, 1/radius]: initially half of the light passes all samples, so
        # that all of them get a gradient.
        density = self.radius * functional.softplus(trunk[..., 0])
        towards_viewer = self.direction(-directions)[:, None].expand(-1, self.samples, -1)
        color = self.scale * torch.sigmoid(self.head(torch.cat((trunk[..., 1:], towards_viewer), -1)))
        traveled = (1 / self.radius - inverse).expand(len(points), -1)
        weights = render_weights(density, traveled, origins.new_full((len(points),), 1 / self.radius))
        return composite(weights.weights, color) + weights.transmittance[:, None] * color[:, -1]

    def _encoded(
        self, points: Float[Tensor, "N M 3"], inverse: Float[Tensor, " M"]
    ) -> Float[Tensor, "N M F"]:
        """Features of the unit vectors `points` at the inverse radii `inverse`."""
        if isinstance(self.position, HashGrid):
            contracted = points * (SHELL_RADIUS - self.radius * inverse)[:, None]
            return self.position(contracted.flatten(0, 1)).view(*points.shape[:2], self.position.width)
        chart = torch.cat((points, inverse[None, :, None].expand(len(points), -1, 1)), -1)
        return self.position(chart)

    def _inverse_radii(self, like: Tensor) -> Float[Tensor, " M"]:
        steps = torch.arange(self.samples, dtype=like.dtype, device=like.device) + 0.5
        return (1 - steps / self.samples) / self.radius


def _on_sphere(
    origins: Float[Tensor, "N 3"], directions: Float[Tensor, "N 3"], radii: Float[Tensor, " M"]
) -> Float[Tensor, "N M 3"]:
    """Where rays from inside cross spheres around the origin, as unit vectors."""
    along = (origins * directions).sum(-1, keepdim=True)
    line_distance_squared = origins.square().sum(-1, keepdim=True) - along.square()
    distance = (radii.square() - line_distance_squared).clamp_min(0).sqrt() - along
    return (origins[:, None] + distance[..., None] * directions[:, None]) / radii[:, None]
