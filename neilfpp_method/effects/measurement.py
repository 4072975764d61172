"""A number that speaks for or against an effect, how sure it is, and what it must exceed."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

__all__ = ["MIN_SAMPLES", "Measurement", "mean_of"]

MIN_SAMPLES = 20
"""Independent samples from which something is concluded."""


@dataclass(frozen=True)
class Measurement:
    """What was measured of an effect.

    Attributes:
        what: of what `value` is the size, a clause.
        value: the mean over the samples; a share, so 0.01 is one hundredth.
        deviation: its standard error.
        threshold: what an effect must be worth; from the module that measured.
        samples: how many independent ones.
    """

    what: str
    value: float
    deviation: float
    threshold: float
    samples: int

    def favours(self, chosen: bool) -> bool | None:
        """Whether to simulate the effect, given whether it is now (`chosen`). None: too few samples.

        An effect that is off must be worth more than the threshold, and more than chance brings about once in
        forty times. One that is on stays unless it is worth less than the threshold, as surely. So nothing
        goes back and forth by chance.
        """
        if self.samples < MIN_SAMPLES:
            return None
        if chosen:
            return self.value + 2 * self.deviation > self.threshold
        return self.value > max(2 * self.deviation, self.threshold)

    def in_words(self) -> str:
        """For people.

        >>> Measurement("directions that meet the surface", 0.042, 0.003, 0.01, 1024).in_words()
        'directions that meet the surface: 4.20 ± 0.30 % (threshold 1 %)'
        """
        share = f"{100 * self.value:.2f} ± {100 * self.deviation:.2f} %".replace("-", "\N{MINUS SIGN}")
        return f"{self.what}: {share} (threshold {100 * self.threshold:g} %)"


def mean_of(values: Float[Tensor, " N"], what: str, threshold: float) -> Measurement:
    """The mean of independent samples and its standard error."""
    count = len(values)
    if count < 2:
        return Measurement(what, 0.0, 0.0, threshold, count)
    spread = values.double().std(correction=1).item() / count**0.5
    return Measurement(what, values.double().mean().item(), spread, threshold, count)
