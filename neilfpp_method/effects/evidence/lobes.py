"""Evidence for the long tails of GGX against the paper's spherical Gaussian.

Places are fitted with either lobe, and the fits are compared in held-back views. The two lobes agree in the
centre of a highlight; GGX also has wide, faint tails, as most real surfaces do.

All places count. The tails are most visible on metals, but the fits classify some paint as metal, and what
such places prefer says nothing about the lobe.
"""

from __future__ import annotations

from neilfpp_method.effects.evidence.alternatives import Alternatives, reduction
from neilfpp_method.effects.measurement import Measurement

__all__ = ["lobe_evidence"]

THRESHOLD = 0.0
"""Threshold for the reduction of the relative error by GGX: since GGX has no cost, any significant reduction
is enough.
"""


def lobe_evidence(alternatives: Alternatives, metals: bool) -> Measurement:
    """Mean reduction of the relative error of the places by GGX against the Gaussian, in held-back views.

    Args:
        alternatives: the ways to explain the places.
        metals: whether metallic may be greater than 0.
    """
    gaussian, ggx = (alternatives.errors(lobe, metals) for lobe in ("spherical_gaussian", "ggx"))
    return reduction(gaussian, ggx, "GGX", THRESHOLD)
