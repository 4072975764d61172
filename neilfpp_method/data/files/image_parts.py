"""What the decoders of image formats share: the header that they return, and the order of the channels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Shaped

__all__ = ["ImageHeader", "rgb_of_opencv"]


@dataclass(frozen=True)
class ImageHeader:
    """Size of an image, and whether its samples are floating point (`hdr`), which are linear radiance."""

    width: int
    height: int
    hdr: bool


def rgb_of_opencv(samples: Shaped[np.ndarray, "H W ..."] | None) -> Shaped[np.ndarray, "H W C"]:
    """Return what OpenCV decoded, with the channels in the order R, G, B, A; one channel stays one.

    Raises:
        ValueError: OpenCV could not decode the file, for which it returns None.
    """
    if samples is None:
        raise ValueError("damaged, or of a kind that OpenCV does not know")
    if samples.ndim == 2:
        return samples[..., None]
    return samples[..., [2, 1, 0, 3][: samples.shape[2]]]
