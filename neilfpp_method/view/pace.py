"""How large a picture may be to be there at once: chosen from the speed that was measured."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

__all__ = ["Pace", "sizes"]

AT_ONCE = 0.12
"""Seconds that the first picture of a wish may take: about eight a second while the camera moves."""
CHECKED = 0.05
"""Seconds between two looks at whether the picture is still wanted."""
UNKNOWN = 20_000.0
"""Rays a second, before any were measured."""
MIN_PIXELS = 256
"""Rays that are traced together at least: fewer cost as much."""
NEW_SHARE = 0.5
"""What the last measurement counts for; the rest is what was known."""


@dataclass
class Pace:
    """Rays a second by layer, as measured."""

    known: dict[str, float] = field(default_factory=dict)

    def note(self, layer: str, rays: int, seconds: float) -> None:
        """Take a measurement in."""
        speed = rays / max(seconds, 1e-6)
        before = self.known.get(layer, speed)
        self.known[layer] = (1 - NEW_SHARE) * before + NEW_SHARE * speed

    def at_once(self, layer: str) -> int:
        """Rays for a first picture."""
        return max(MIN_PIXELS, int(AT_ONCE * self.known.get(layer, UNKNOWN)))

    def together(self, layer: str) -> int:
        """Rays until the next look at whether the picture is still wanted."""
        return max(MIN_PIXELS, int(CHECKED * self.known.get(layer, UNKNOWN)))


def sizes(width: int, height: int, at_once: int) -> list[float]:
    """Factors of ever larger pictures, up to 1; the first has no more pixels than `at_once`, about, and each
    that follows has four times as many, or fewer.

    >>> sizes(640, 480, 19_200)
    [0.25, 0.5, 1.0]
    """
    smallest = math.sqrt(at_once / (width * height))
    factors = [1.0]
    while factors[0] > smallest * 1.001:
        factors.insert(0, factors[0] / 2)
    return factors
