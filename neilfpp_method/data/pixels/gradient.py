"""Gradients of images, which weigh the smoothness of the material."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

__all__ = ["NEIGHBORS", "image_gradient", "scharr"]

NEIGHBORS = np.array([(row, column) for row in (-1, 0, 1) for column in (-1, 0, 1)])
"""Offsets (row, column) of the 3 × 3 neighbourhood of a pixel."""


def image_gradient(values: Float[Tensor, "H W"]) -> Float[Tensor, "H W"]:
    """Return the gradient (`scharr`) of a whole image, with replicated borders."""
    padded = torch.nn.functional.pad(values[None, None], (1, 1, 1, 1), mode="replicate")[0, 0]
    height, width = values.shape
    return scharr(
        [padded[1 + row : 1 + row + height, 1 + column : 1 + column + width] for row, column in NEIGHBORS]
    )


def scharr(about: Sequence[Float[Tensor, "*shape"]]) -> Float[Tensor, "*shape"]:
    """Return the length of the Scharr gradient at pixels, from the values at their `NEIGHBORS`.

    The usual factor of 1/32 is left out, so a ramp of 0.01 per pixel has the value 0.32. The weight of L_smth
    is the exponential of this value, as in the published code; with the factor, no edge of an image would
    have an effect.
    """
    right = 3 * (about[2] - about[0]) + 10 * (about[5] - about[3]) + 3 * (about[8] - about[6])
    down = 3 * (about[6] - about[0]) + 10 * (about[7] - about[1]) + 3 * (about[8] - about[2])
    return torch.hypot(right, down)
