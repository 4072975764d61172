"""Hash-grid encoding: one contract, several backends.

Every backend computes what `reference.encode` computes, which the tests hold it to.
"""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from neilfpp_method.kernels import reference
from neilfpp_method.kernels.grid import Encoded, GridSpec, grid_spec

__all__ = ["Encoded", "GridSpec", "encode", "grid_spec"]


def encode(x01: Float[Tensor, "N 3"], table: Float[Tensor, "T F"], spec: GridSpec, jacobian: bool) -> Encoded:
    """Features of a multiresolution grid at points of the unit cube, by the best backend for their device.

    Args:
        x01: points; outside [0, 1]³ the nearest point of the cube counts, and the derivative across its face is 0.
        table: `spec.entries` rows of `spec.features`.
        spec: the layout of the table.
        jacobian: whether to return d features / d x01 as well.

    Returns:
        `spec.width` features per point, in the dtype of the table. Features and Jacobian can be differentiated with
        respect to the table and the points. The memory order of what is returned is the backend's own.
    """
    return reference.encode(x01, table, spec, jacobian)
