"""Choose the size of the first image from the measured rendering speed, so that it appears immediately."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

__all__ = ["RenderSpeed", "sizes"]

FIRST_IMAGE_SECONDS = 0.12
"""Seconds that the first image of a view may take, which gives about eight images per second while the camera
moves.
"""
BATCH_SECONDS = 0.05
"""Seconds that a batch of rays should take. Between batches, an outdated image can be abandoned."""
DEFAULT_SPEED = 20_000.0
"""Assumed rays per second before the first measurement."""
MIN_RAYS = 256
"""Smallest batch; a smaller one would take as long."""
NEW_WEIGHT = 0.5
"""Weight of the newest measurement in the moving average."""


@dataclass
class RenderSpeed:
    """Measured rendering speed by layer, rays per second."""

    by_layer: dict[str, float] = field(default_factory=dict)

    def note(self, layer: str, rays: int, seconds: float) -> None:
        """Add a measurement."""
        measured = rays / max(seconds, 1e-6)
        before = self.by_layer.get(layer, measured)
        self.by_layer[layer] = (1 - NEW_WEIGHT) * before + NEW_WEIGHT * measured

    def first_image(self, layer: str) -> int:
        """Number of rays of a first image."""
        return max(MIN_RAYS, int(FIRST_IMAGE_SECONDS * self.by_layer.get(layer, DEFAULT_SPEED)))

    def batch(self, layer: str) -> int:
        """Number of rays of a batch."""
        return max(MIN_RAYS, int(BATCH_SECONDS * self.by_layer.get(layer, DEFAULT_SPEED)))


def sizes(width: int, height: int, at_once: int) -> list[float]:
    """Scale factors of successively larger images, up to 1.

    The first image has about `at_once` pixels or fewer; each further one has at most four times as many.

    >>> sizes(640, 480, 19_200)
    [0.25, 0.5, 1.0]
    """
    smallest = math.sqrt(at_once / (width * height))
    factors = [1.0]
    while factors[0] > smallest * 1.001:
        factors.insert(0, factors[0] / 2)
    return factors
