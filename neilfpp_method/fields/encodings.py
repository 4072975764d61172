"""Encodings of positions and directions.

A position encoding has `forward`, `with_jacobian`, a `width` (number of features) and a `step`: the step size
of finite differences that resolves its finest detail, in scene units. The first three features are always the
position itself.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from neilfpp_method.errors import UserError
from neilfpp_method.kernels import Encoded, GridSpec, encode, grid_spec
from neilfpp_method.settings.types import FrequencyConfig, HashGridConfig

__all__ = [
    "FrequencyEncoding",
    "HashGrid",
    "Raw",
    "SphericalHarmonics",
    "direction_encoding",
    "position_encoding",
    "pull_back",
]

POSITION_OCTAVES = 6
"""Octaves of the frequency encoding of positions (NeILF++ §5); the shortest wave is 1/32 of the longest."""


def pull_back(gradient: Float[Tensor, "N K F"], encoded: Encoded) -> Float[Tensor, "N K 3"]:
    """Chain rule: turn the gradient of K outputs with respect to an encoding into that with respect to x."""
    return torch.einsum("nkf,nfj->nkj", gradient, encoded.jacobian)


# -------------------------------------------------------------------------------------------------- positions


class Raw(nn.Module):
    """The position without an encoding."""

    width = 3
    step = 1e-3

    def forward(self, x: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
        return x

    def with_jacobian(self, x: Float[Tensor, "N 3"]) -> Encoded:
        return Encoded(x, _identity(x))


class FrequencyEncoding(nn.Module):
    """x, sin(2ᵏ x), cos(2ᵏ x) for k = 0 … octaves − 1 (NeRF eq. 4, without its π, as in IDR and VolSDF)."""

    def __init__(self, octaves: int, dimensions: int = 3) -> None:
        super().__init__()
        self.width = dimensions * (1 + 2 * octaves)
        # The phase of the shortest wave changes by 0.02 rad per step.
        self.step = 0.02 / 2 ** max(octaves - 1, 0)
        self.register_buffer("frequencies", 2.0 ** torch.arange(octaves), persistent=False)

    def forward(self, x: Float[Tensor, "... D"]) -> Float[Tensor, "... F"]:
        angles = self._angles(x)
        return torch.cat((x, angles.sin().flatten(-2), angles.cos().flatten(-2)), -1)

    def with_jacobian(self, x: Float[Tensor, "N 3"]) -> Encoded:
        angles, frequencies = self._angles(x), self.frequencies.to(x.dtype)[:, None]
        sin, cos = angles.sin(), angles.cos()
        # Each feature depends on one coordinate: the Jacobian is a column of diagonal blocks.
        slopes = torch.cat((torch.ones_like(x)[:, None], frequencies * cos, -frequencies * sin), 1)
        features = torch.cat((x, sin.flatten(1), cos.flatten(1)), 1)
        return Encoded(features, slopes.diag_embed().flatten(1, 2))

    def _angles(self, x: Float[Tensor, "... D"]) -> Float[Tensor, "... K D"]:
        return x[..., None, :] * self.frequencies.to(x.dtype)[:, None]


class HashGrid(nn.Module):
    """The position, and features of a multiresolution hash grid over the cube around the scene sphere.

    The table is initialised with U(−1e−4, 1e−4) (Müller et al. 2022, §4).

    Args:
        spec: sizes and backend of the grid.
        radius: radius of the scene sphere, scene units.
    """

    def __init__(self, spec: GridSpec, radius: float) -> None:
        super().__init__()
        self.spec = spec
        self.radius = radius
        self.width = 3 + self.spec.width
        self.step = 2 * radius / self.spec.resolutions[-1]
        self.table = nn.Parameter(torch.empty(self.spec.entries, self.spec.features).uniform_(-1e-4, 1e-4))

    def forward(self, x: Float[Tensor, "N 3"]) -> Float[Tensor, "N F"]:
        grid = encode(self._in_cube(x), self.table, self.spec, jacobian=False)
        return torch.cat((x, grid.features), 1)

    def with_jacobian(self, x: Float[Tensor, "N 3"]) -> Encoded:
        grid = encode(self._in_cube(x), self.table, self.spec, jacobian=True)
        jacobian = torch.cat((_identity(x), grid.jacobian / (2 * self.radius)), 1)
        return Encoded(torch.cat((x, grid.features), 1), jacobian)

    def _in_cube(self, x: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
        return x / (2 * self.radius) + 0.5


def _identity(x: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3 3"]:
    """The Jacobian of the position itself."""
    return torch.eye(3, dtype=x.dtype, device=x.device).expand(x.shape[0], 3, 3)


def position_encoding(
    config: FrequencyConfig | HashGridConfig, radius: float, log2_entries: int | None = None
) -> FrequencyEncoding | HashGrid:
    """Make the position encoding of a configuration.

    Args:
        config: kind and sizes.
        radius: radius of the scene sphere, which contains the positions.
        log2_entries: binary logarithm of the table size of one grid level; if None, `config.log2_entries`.
    """
    if isinstance(config, FrequencyConfig):
        return FrequencyEncoding(POSITION_OCTAVES)
    return HashGrid(
        grid_spec(config.levels, log2_entries or config.log2_entries, config.max_resolution), radius
    )


# ------------------------------------------------------------------------------------------------- directions


class SphericalHarmonics(nn.Module):
    """Encoding of unit vectors by real spherical harmonics, without Condon–Shortley phase.

    The functions are sorted by band, and within a band by ascending order m. They are orthonormal.

    Args:
        degree: number of bands, 1 to 5.

    Raises:
        UserError: the number of bands is out of range.
    """

    def __init__(self, degree: int) -> None:
        super().__init__()
        if not 1 <= degree <= len(BANDS):
            raise UserError(f"spherical harmonics of {degree} bands", "choose 1 to 5")
        self.degree = degree
        self.width = degree**2

    def forward(self, directions: Float[Tensor, "... 3"]) -> Float[Tensor, "... F"]:
        x, y, z = directions.unbind(-1)
        return torch.stack([value for band in BANDS[: self.degree] for value in band(x, y, z)], -1)


# The bands as polynomials in x, y, z with x² + y² + z² = 1. The square of each integrates to 1 over the
# sphere.
BANDS: tuple[Callable[[Tensor, Tensor, Tensor], list[Tensor]], ...] = (
    lambda x, y, z: [torch.full_like(x, 0.28209479177387814)],
    lambda x, y, z: [0.4886025119029199 * y, 0.4886025119029199 * z, 0.4886025119029199 * x],
    lambda x, y, z: [
        1.0925484305920792 * x * y,
        1.0925484305920792 * y * z,
        0.31539156525252005 * (3 * z * z - 1),
        1.0925484305920792 * x * z,
        0.5462742152960396 * (x * x - y * y),
    ],
    lambda x, y, z: [
        0.5900435899266435 * y * (3 * x * x - y * y),
        2.890611442640554 * x * y * z,
        0.4570457994644658 * y * (5 * z * z - 1),
        0.3731763325901154 * z * (5 * z * z - 3),
        0.4570457994644658 * x * (5 * z * z - 1),
        1.445305721320277 * z * (x * x - y * y),
        0.5900435899266435 * x * (x * x - 3 * y * y),
    ],
    lambda x, y, z: [
        2.5033429417967046 * x * y * (x * x - y * y),
        1.7701307697799304 * y * z * (3 * x * x - y * y),
        0.9461746957575601 * x * y * (7 * z * z - 1),
        0.6690465435572892 * y * z * (7 * z * z - 3),
        0.10578554691520431 * (z * z * (35 * z * z - 30) + 3),
        0.6690465435572892 * x * z * (7 * z * z - 3),
        0.47308734787878004 * (x * x - y * y) * (7 * z * z - 1),
        1.7701307697799304 * x * z * (x * x - 3 * y * y),
        0.6258357354491761 * (x * x * (x * x - 3 * y * y) - y * y * (3 * x * x - y * y)),
    ],
)


def direction_encoding(
    kind: Literal["frequency", "spherical_harmonics"], octaves: int, bands: int
) -> FrequencyEncoding | SphericalHarmonics:
    """Make a direction encoding: frequencies with `octaves`, or spherical harmonics with `bands`."""
    return FrequencyEncoding(octaves) if kind == "frequency" else SphericalHarmonics(bands)
