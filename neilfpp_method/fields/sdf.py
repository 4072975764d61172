"""G: position → signed distance to the surface, negative inside, and a feature that R reads (METHOD §5)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from neilfpp_method.fields.encodings import FrequencyEncoding, position_encoding, pull_back
from neilfpp_method.fields.mlp import Mlp, geometric_init_, middle_skip, weight_normalise_
from neilfpp_method.settings.types import FrequencyConfig, HashGridConfig, SdfConfig

__all__ = ["SdfField", "SdfSample"]

FIRST_RADIUS = 0.6
"""Of the sphere that the field starts as, scene units: most of the unit sphere that holds the object."""


@dataclass(frozen=True)
class SdfSample:
    """The field at N points. `gradient` is not normalised; it is where the eikonal loss looks."""

    distance: Float[Tensor, " N"]
    gradient: Float[Tensor, "N 3"]
    feature: Float[Tensor, "N F"]


class SdfField(nn.Module):
    """Starts as a sphere around the origin, negative inside.

    Behind a frequency encoding (the paper's MLP setting) the waves start with no weight and the weights are
    normalised, as in IDR and VolSDF. Behind a hash grid, whose features start near 0 themselves, neither is
    called for.
    """

    def __init__(self, config: SdfConfig, encoding: FrequencyConfig | HashGridConfig, radius: float) -> None:
        super().__init__()
        waves = isinstance(encoding, FrequencyConfig)
        self.encoding = position_encoding(encoding, radius, None if waves else encoding.sdf_log2_entries)
        outputs = 1 + config.feature_width
        self.mlp = Mlp(
            self.encoding.width, outputs, config.layers, config.width, "softplus", middle_skip(config.layers)
        )
        geometric_init_(self.mlp, FIRST_RADIUS, extent=radius, encoded=0.0 if waves else 1.0)
        if waves:
            weight_normalise_(self.mlp)

    def forward(self, x: Float[Tensor, "N 3"]) -> Float[Tensor, " N"]:
        """The distance alone."""
        return self.mlp(self.encoding(x), slice(0, 1))[:, 0]

    def with_gradient(self, x: Float[Tensor, "N 3"]) -> SdfSample:
        """Distance, feature and ∇G. A loss on the gradient needs only first-order autograd."""
        encoded = self.encoding.with_jacobian(x)
        sample = self.mlp.with_gradient(encoded.features, slice(0, 1))
        return SdfSample(sample.value[:, 0], pull_back(sample.gradient, encoded)[:, 0], sample.value[:, 1:])

    def hessian(
        self, x: Float[Tensor, "N 3"], method: Literal["analytic", "finite_difference"] | None = None
    ) -> Float[Tensor, "N 3 3"]:
        """H_ij = ∂²G / ∂x_i ∂x_j; a loss on it reaches the parameters.

        analytic: autograd through `with_gradient`. Exact, but inside a grid cell a trilinear function has no
        curvature along the axes. finite_difference: forward differences of the gradient over one cell of the
        finest grid (for waves, a fiftieth of a radian of the finest), which see the curvature that lies in
        the kinks between cells. None: the former for waves, the latter for a grid.
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
