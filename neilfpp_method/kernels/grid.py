"""The layout of a multiresolution grid in memory, and what its encoding returns.

A level of resolution r has (r + 1)³ vertices. Where they fit into the table of a level they are stored one after the
other, x fastest; where they do not, vertices share entries by the spatial hash of Müller et al. (2022, eq. 4).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate

from jaxtyping import Float
from torch import Tensor

from neilfpp_method.errors import UserError
from neilfpp_method.settings.types import HashGridConfig

__all__ = ["Encoded", "GridSpec", "grid_spec"]


@dataclass(frozen=True)
class GridSpec:
    """Levels, coarse to fine, of a grid over the unit cube. All levels lie one after the other in one table."""

    resolutions: tuple[int, ...]
    """Cells along an edge, per level."""
    entries_per_level: tuple[int, ...]
    """Table rows, per level: every vertex of a dense level, a power of two for a hashed one."""
    features: int
    """Length of a table row."""
    backend: str = "auto"
    """Who computes it: `HashGridConfig.backend`."""

    @cached_property
    def offsets(self) -> tuple[int, ...]:
        """First table row of each level, and the number of rows at the end."""
        return tuple(accumulate(self.entries_per_level, initial=0))

    @property
    def entries(self) -> int:
        """Rows of the whole table."""
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
    """Features at N points and, where asked for, their derivative with respect to the point."""

    features: Float[Tensor, "N F"]
    jacobian: Float[Tensor, "N F 3"] | None


def grid_spec(config: HashGridConfig) -> GridSpec:
    """The layout that a configuration asks for: resolutions grow geometrically from base to max.

    Raises:
        UserError: the configuration describes no grid.
    """
    base, finest = config.base_resolution, config.max_resolution
    if config.levels < 1 or config.features < 1 or not 1 <= base <= finest or not 1 <= config.log2_entries <= 24:
        raise UserError(
            f"no such hash grid: {config}",
            "it needs levels, features ≥ 1, 1 ≤ base_resolution ≤ max_resolution, 1 ≤ log2_entries ≤ 24",
        )
    growth = (finest / base) ** (1 / max(config.levels - 1, 1))
    resolutions = tuple(round(base * growth**level) for level in range(config.levels))
    entries = tuple(min((r + 1) ** 3, 2**config.log2_entries) for r in resolutions)
    return GridSpec(resolutions, entries, config.features, config.backend)
