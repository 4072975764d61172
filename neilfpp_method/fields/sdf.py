"""The signed distance field G: position → distance, negative inside, and a feature for R (METHOD §5)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from neilfpp_method.fields.encodings import FrequencyEncoding, position_encoding, pull_back
from neilfpp_method.fields.mlp import Mlp, geometric_init_, middle_skip, weight_normalize_
from neilfpp_method.settings.types import FrequencyConfig, HashGridConfig, SdfConfig

__all__ = ["SdfField", "SdfSample"]

FIRST_RADIUS = 0.6
"""Radius of the sphere that the field starts as, scene units. The object lies in the unit sphere."""


@dataclass(frozen=True)
class SdfSample:
    """Distance at N points in scene units, its gradient (not normalised), and the feature for R."""

    distance: Float[Tensor, " N"]
    gradient: Float[Tensor, "N 3"]
    feature: Float[Tensor, "N F"]


class SdfField(nn.Module):
    """A network of position that starts as a sphere around the origin.

    With a frequency encoding (the paper's MLP setting) the encoded inputs start with weight 0 and the weights
    are normalised, as in IDR and VolSDF. With a hash grid, whose features start near 0, neither is needed.

    Args:
        config: sizes of the network.
        encoding: encoding of positions.
        radius: radius of the scene sphere, scene units.
    """

    def __init__(self, config: SdfConfig, encoding: FrequencyConfig | HashGridConfig, radius: float) -> None:
        super().__init__()
        waves = isinstance(encoding, FrequencyConfig)
        self.encoding = position_encoding(encoding, radius, None if waves else encoding.sdf_log2_entries)
        outputs = 1 + config.feature_width
        skip = middle_skip(config.layers)
        self.mlp = Mlp(self.encoding.width, outputs, config.layers, config.width, "softplus", skip=skip)
        geometric_init_(self.mlp, FIRST_RADIUS, extent=radius, encoded=0.0 if waves else 1.0)
        if waves:
            weight_normalize_(self.mlp)

    def forward(self, x: Float[Tensor, "N 3"]) -> Float[Tensor, " N"]:
        """Signed distance only."""
        return self.mlp(self.encoding(x), slice(0, 1))[:, 0]

    def with_gradient(self, x: Float[Tensor, "N 3"]) -> SdfSample:
        """Distance, feature and ∇G. A loss on the gradient needs only first-order autograd."""
        encoded = self.encoding.with_jacobian(x)
        sample = self.mlp.with_gradient(encoded.features, slice(0, 1))
        return SdfSample(sample.value[:, 0], pull_back(sample.gradient, encoded)[:, 0], sample.value[:, 1:])

    @torch.no_grad()
    def lower_(self, amount: float) -> None:
        """Subtract a constant from the distance everywhere."""
        self.mlp.layers[-1].bias[0] -= amount

    def hessian(
        self, x: Float[Tensor, "N 3"], method: Literal["analytic", "finite_difference"] | None = None
    ) -> Float[Tensor, "N 3 3"]:
        """Hessian H_ij = ∂²G / ∂x_i ∂x_j, differentiable in the parameters.

        Args:
            x: points, scene frame.
            method: "analytic" differentiates `with_gradient` by autograd. It is exact, but a trilinear
                function has no curvature along the axes inside a cell. "finite_difference" takes forward
                differences of the gradient over one cell of the finest grid (for frequencies, 0.02 rad of
                the highest one), and so includes the kinks between cells. If None, analytic for frequencies,
                finite differences for a hash grid.
        """
        method = method or (
            "analytic" if isinstance(self.encoding, FrequencyEncoding) else "finite_difference"
        )
        return self._analytic_hessian(x) if method == "analytic" else self._difference_hessian(x)

    def _analytic_hessian(self, x: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3 3"]:
        keep_graph = torch.is_grad_enabled()
        with torch.enable_grad():
            x = x if x.requires_grad else x.detach().requires_grad_()
            components = self.with_gradient(x).gradient.sum(0)
            rows = [
                torch.autograd.grad(c, x, create_graph=keep_graph, retain_graph=True)[0] for c in components
            ]
        return torch.stack(rows, 1)

    def _difference_hessian(self, x: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3 3"]:
        steps = self.encoding.step * torch.eye(3, dtype=x.dtype, device=x.device)
        points = torch.cat((x[None], x + steps[:, None]))
        gradient = self.with_gradient(points.flatten(0, 1)).gradient.view_as(points)
        return (gradient[1:] - gradient[0]).permute(1, 2, 0) / self.encoding.step
