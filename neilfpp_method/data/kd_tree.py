"""Trees for the search of nearest points."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

__all__ = ["kd_tree"]


def kd_tree(points: Float[np.ndarray, "N D"]) -> cKDTree:
    """A tree for the search of nearest points, also in processes that flush denormal numbers to 0.

    Its boxes are divided in the middle. SciPy's default divides at the median; if more than half of the
    points have the smallest value of a coordinate, and it is 0, then it divides at the next larger number.
    This number is denormal. If it is flushed to 0 (`kernels.process`), the division separates one point at
    a time, and a hundred thousand points overflow the stack. The normals of floors and walls have such
    coordinates.

    Example:
        distance, index = kd_tree(surface).query(points)
    """
    return cKDTree(points, balanced_tree=False)
