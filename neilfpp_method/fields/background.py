"""What lies beyond the scene sphere: an inverted-sphere radiance field (NeRF++, Zhang et al. 2020, §4)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from neilfpp_method.fields.encodings import FrequencyEncoding
from neilfpp_method.fields.mlp import Mlp
from neilfpp_method.settings.types import BackgroundConfig
from neilfpp_method.volume.compositing import composite, render_weights

__all__ = ["InvertedSphere", "field_beyond"]

POSITION_OCTAVES = 10
DIRECTION_OCTAVES = 4
MIN_START = 1e-2
"""Share of the largest radiance that the field starts away from both ends of its sigmoid, at least."""
START_SCALE = 1e-3
"""Of the weights that make it vary at the start."""


def field_beyond(
    kind: str, config: BackgroundConfig, radius: float, scale: float, start: Float[Tensor, " 3"]
) -> InvertedSphere | None:
    """What lies beyond the scene sphere, where `kind` says that it is an inverted sphere; see there."""
    return InvertedSphere(config, radius, scale, start) if kind == "inverted_sphere" else None


class InvertedSphere(nn.Module):
    """A point at distance r > radius from the origin is (x/r, 1/r): unbounded space in a bounded chart.

    Density is per unit of 1/r, and samples are the midpoints of equal steps of 1/r from the sphere to
    infinity. What passes them all has the colour of the last.

    Args:
        config: the settings.
        radius: of the scene sphere.
        scale: the largest radiance that it can reach.
        start: linear RGB that it starts as, all around; none: half of the largest.
    """

    def __init__(
        self,
        config: BackgroundConfig,
        radius: float,
        scale: float,
        start: Float[Tensor, " 3"] | None = None,
    ) -> None:
        super().__init__()
        self.radius = radius
        self.scale = scale
        self.samples = config.samples
        self.position = FrequencyEncoding(POSITION_OCTAVES, dimensions=4)
        self.direction = FrequencyEncoding(DIRECTION_OCTAVES)
        width = config.width
        self.trunk = Mlp(
            self.position.width, 1 + width, config.layers, width, "relu", skip=config.layers // 2
        )
        self.head = Mlp(width + self.direction.width, 3, 1, width // 2, "relu", output_scale=START_SCALE)
        if start is not None:
            with torch.no_grad():
                self.head.layers[-1].bias.copy_(torch.logit(start / scale, eps=MIN_START))

    def forward(
        self, origins: Float[Tensor, "N 3"], directions: Float[Tensor, "N 3"]
    ) -> Float[Tensor, "N 3"]:
        """Radiance in [0, scale] that reaches the sphere along each ray from outside.

        Args:
            origins: inside the sphere.
            directions: unit vectors, from the origin out.
        """
        inverse = self._inverse_radii(origins)
        points = _on_sphere(origins, directions, 1 / inverse)
        chart = torch.cat((points, inverse[None, :, None].expand(len(points), -1, 1)), -1)
        trunk = self.trunk(self.position(chart))
        # In units of 1/radius, the chart's length: a fresh field stops half the light, so all samples count.
        density = self.radius * functional.softplus(trunk[..., 0])
        towards_viewer = self.direction(-directions)[:, None].expand(-1, self.samples, -1)
        color = self.scale * torch.sigmoid(self.head(torch.cat((trunk[..., 1:], towards_viewer), -1)))
        travelled = (1 / self.radius - inverse).expand(len(points), -1)
        weights = render_weights(density, travelled, origins.new_full((len(points),), 1 / self.radius))
        return composite(weights.weights, color) + weights.transmittance[:, None] * color[:, -1]

    def _inverse_radii(self, like: Tensor) -> Float[Tensor, " M"]:
        steps = torch.arange(self.samples, dtype=like.dtype, device=like.device) + 0.5
        return (1 - steps / self.samples) / self.radius


def _on_sphere(
    origins: Float[Tensor, "N 3"], directions: Float[Tensor, "N 3"], radii: Float[Tensor, " M"]
) -> Float[Tensor, "N M 3"]:
    """Where rays from within cross spheres around the origin, as unit vectors."""
    along = (origins * directions).sum(-1, keepdim=True)
    missed = (
        origins.square().sum(-1, keepdim=True) - along.square()
    )  # squared distance of the line from the origin
    distance = (radii.square() - missed).clamp_min(0).sqrt() - along
    return (origins[:, None] + distance[..., None] * directions[:, None]) / radii[:, None]
