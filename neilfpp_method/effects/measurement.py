"""A measured benefit of an effect, its standard error, and the threshold that it must exceed."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.lighting.decision import is_worthwhile

__all__ = ["Measurement", "mean_of", "mean_reduction"]


@dataclass(frozen=True)
class Measurement:
    """The measured benefit of an effect.

    Attributes:
        what: description of the measured quantity, for the table of effects.
        value: mean over the samples, a share (0.01 is 1 %).
        deviation: standard error of the mean.
        threshold: value above which the effect is worth its cost.
        samples: number of independent samples.
    """

    what: str
    value: float
    deviation: float
    threshold: float
    samples: int

    def favours(self, chosen: bool) -> bool | None:
        """Whether the effect should be simulated; None if there are too few samples (`is_worthwhile`).

        Args:
            chosen: whether the effect is on now.
        """
        return is_worthwhile(
            benefit=self.value,
            deviation=self.deviation,
            threshold=self.threshold,
            samples=self.samples,
            chosen=chosen,
        )

    def summary(self) -> str:
        """One clause for the console and the report.

        >>> Measurement("directions that meet the surface", 0.042, 0.003, 0.01, 1024).summary()
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


def mean_reduction(turns: Iterable[Float[Tensor, " P"]], what: str, threshold: float) -> Measurement:
    """The mean reduction of the error of places, each averaged over the turns first.

    Args:
        turns: for each fold that is held back, the reduction of the error of each place by the effect; NaN
            for a place without held-back pixels.
        what: description of the measurement.
        threshold: reduction above which the effect is used.
    """
    reduction = torch.stack(list(turns)).nanmean(0)
    return mean_of(reduction[reduction.isfinite()], what, threshold)
