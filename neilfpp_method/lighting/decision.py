"""The rule by which a measured benefit decides whether a scene gets something, such as lamps."""

from __future__ import annotations

__all__ = ["MIN_SAMPLES", "is_worthwhile"]

MIN_SAMPLES = 20
"""Minimum number of independent samples for a decision."""


def is_worthwhile(
    *, benefit: float, deviation: float, threshold: float, samples: int, chosen: bool
) -> bool | None:
    """Whether something should be used; None if there are too few samples.

    What is not in use is added if its benefit is significant (two standard errors) and above the threshold.
    What is in use stays unless its benefit is below the threshold by two standard errors. This hysteresis
    prevents switching back and forth by chance.

    Args:
        benefit: mean over the samples.
        deviation: standard error of that mean.
        threshold: benefit above which its cost is worth it.
        samples: number of independent samples.
        chosen: whether it is in use now.
    """
    if samples < MIN_SAMPLES:
        return None
    if chosen:
        return benefit + 2 * deviation > threshold
    return benefit > max(2 * deviation, threshold)
