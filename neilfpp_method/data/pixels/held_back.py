"""Choose held-back pixels: pixels of training views that no step uses, to measure quality during training.

They are small patches on the object, spread over the views. Test views are not used for this purpose.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

import numpy as np
import torch
from jaxtyping import Int

from neilfpp_method.data.pixels.dataset import PixelDataset
from neilfpp_method.data.pixels.drawing import MASK, VALID, PixelSet
from neilfpp_method.structures import PixelBatch

__all__ = ["PATCHES", "SIDE", "hold_back"]

PATCHES, SIDE = 16, 4
"""Number of patches, and their side in pixels."""
MAX_SHARE = 1 / 32
"""Largest share of the object's pixels that is held back; small captures have fewer patches, or none."""
TRIES = 64
"""Number of random positions per patch that are tried, because some overlap other patches or cross the border
of the image."""


def hold_back(pixels: PixelDataset, seed: int, patches: int = PATCHES) -> PixelBatch:
    """Exclude patches of pixels from all later draws of `pixels`.

    The choice depends only on the seed and the capture; torch's generators are not used. The image gradients
    of other pixels are still computed from the colours of held-back neighbours.

    Args:
        pixels: the pixels of the training views.
        seed: seed of the training.
        patches: maximum number of patches.

    Returns:
        The pixels of the patches that are valid and on the object.
    """
    bits = pixels.store.bits
    of_object = PixelSet(bits, VALID | MASK)
    count = min(patches, int(MAX_SHARE * of_object.count) // SIDE**2)
    taken: set[int] = set()
    in_view: Counter[int] = Counter()
    max_in_view = -(-count // len(pixels.views))
    for view, patch in _places(pixels, of_object, seed, TRIES * count):
        if in_view.total() == count:
            break
        if in_view[view] < max_in_view and taken.isdisjoint(patch.tolist()):
            taken.update(patch.tolist())
            in_view[view] += 1
    numbers = np.array(sorted(taken), dtype=np.int64)
    pixels.leave_out(torch.from_numpy(numbers))
    return pixels.numbered(torch.from_numpy(numbers[(bits[numbers] & (VALID | MASK)) == (VALID | MASK)]))


def _places(
    pixels: PixelDataset, of_object: PixelSet, seed: int, tries: int
) -> Iterator[tuple[int, Int[np.ndarray, " N"]]]:
    """Yield random patches around pixels of the object, as a view and the indices of the patch's pixels."""
    if not of_object.count:
        return
    kth = np.random.default_rng(seed).integers(of_object.count, size=tries)
    numbers = of_object.find(torch.from_numpy(kth)).numpy()
    for number, view in zip(numbers.tolist(), pixels.store.views_of(numbers).tolist(), strict=True):
        start, camera = int(pixels.store.starts[view]), pixels.views[view].camera
        row, column = divmod(number - start, camera.width)
        top, left = row - SIDE // 2, column - SIDE // 2
        if top < 0 or left < 0 or top + SIDE > camera.height or left + SIDE > camera.width:
            continue
        rows, columns = np.arange(top, top + SIDE), np.arange(left, left + SIDE)
        yield view, (start + rows[:, None] * camera.width + columns).reshape(-1)
