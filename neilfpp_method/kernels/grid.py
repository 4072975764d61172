"""The memory layout of a multiresolution grid, and the result of its encoding.

A level of resolution r has (r + 1)³ vertices. If they fit into the table of the level, they are stored one
after the other, with x varying fastest. Otherwise vertices share entries by the spatial hash of Müller et al.
(2022, eq. 4).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate

from jaxtyping import Float
from torch import Tensor

from neilfpp_method.errors import UserError

__all__ = ["Encoded", "GridSpec", "grid_spec"]

BASE_RESOLUTION = 16
"""Cells along an edge at the coarsest level, as in Müller et al. (2022)."""
FEATURES = 2
"""Features per vertex, as in Müller et al. (2022)."""


@dataclass(frozen=True)
class GridSpec:
    """The layout of a grid over the unit cube. Its levels, coarse to fine, are stored in a single table."""

    resolutions: tuple[int, ...]
    """Cells along an edge, per level."""
    entries_per_level: tuple[int, ...]
    """Table rows per level: one per vertex of a dense level, a power of two for a hashed one."""
    features: int
    """Length of a table row."""
    backend: str = "auto"
    """The backend: auto (the fastest for the device), reference (torch), cpu (Numba) or triton (CUDA)."""

    @cached_property
    def offsets(self) -> tuple[int, ...]:
        """First table row of each level, followed by the number of all rows."""
        return tuple(accumulate(self.entries_per_level, initial=0))

    @property
    def entries(self) -> int:
        """Number of rows of the table."""
        return self.offsets[-1]

    @property
    def width(self) -> int:
        """Length of the encoding: the features of all levels, coarse to fine."""
        return len(self.resolutions) * self.features

    def is_dense(self, level: int) -> bool:
        """Whether every vertex of a level has a row of its own."""
        return (self.resolutions[level] + 1) ** 3 <= self.entries_per_level[level]


@dataclass(frozen=True)
class Encoded:
    """Features at N points, and their derivative with respect to the point; None if not requested."""

    features: Float[Tensor, "N F"]
    jacobian: Float[Tensor, "N F 3"] | None


def grid_spec(
    levels: int,
    log2_entries: int,
    max_resolution: int,
    base_resolution: int = BASE_RESOLUTION,
    features: int = FEATURES,
    backend: str = "auto",
) -> GridSpec:
    """Make a layout whose resolutions grow geometrically from coarse to fine.

    Args:
        levels: number of levels.
        log2_entries: maximum number of table rows of a level, as a power of two.
        max_resolution: cells along an edge at the finest level.
        base_resolution: cells along an edge at the coarsest level.
        features: features per vertex.
        backend: see `GridSpec.backend`.

    Raises:
        UserError: if no grid has these numbers.
    """
    if (
        levels < 1
        or features < 1
        or not 1 <= base_resolution <= max_resolution
        or not 1 <= log2_entries <= 24
    ):
        raise UserError(
            f"no hash grid has {levels} levels of {base_resolution} to {max_resolution} cells and "
            f"2^{log2_entries} entries",
            f"choose levels ≥ 1, max_resolution ≥ {base_resolution}, 1 ≤ log2_entries ≤ 24",
        )
    growth = (max_resolution / base_resolution) ** (1 / max(levels - 1, 1))
    resolutions = tuple(round(base_resolution * growth**level) for level in range(levels))
    entries = tuple(min((r + 1) ** 3, 2**log2_entries) for r in resolutions)
    return GridSpec(resolutions, entries, features, backend)
