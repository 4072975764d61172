"""Judge whether the radiance in the images of a capture is good enough for the estimation of materials."""

from __future__ import annotations

from collections.abc import Sequence, Set
from dataclasses import dataclass
from typing import Literal

import numpy as np

from neilfpp_method.inspection.measure import ViewFigures

__all__ = ["RadianceQuality", "radiance_quality"]

CLIPPED_A_BIT, CLIPPED_MUCH = 0.001, 0.02
"""Shares of clipped pixels on the object, as a mean over the views, above which linear radiance is limited,
and above which any radiance is poor.
"""


@dataclass(frozen=True)
class RadianceQuality:
    """Whether radiance is good enough for the estimation of materials.

    Attributes:
        level: "good", "limited" or "poor".
        text: what the images hold, and the reason for the level.
    """

    level: Literal["good", "limited", "poor"]
    text: str


def radiance_quality(views: Sequence[ViewFigures], hdr: bool, defects: Set[str]) -> RadianceQuality:
    """Judge the radiance of a capture.

    Args:
        views: figures of each view.
        hdr: whether the pixels hold linear radiance, rather than display values.
        defects: kinds of the defects of the capture.

    Example:
        >>> radiance_quality([], hdr=True, defects=set())
        RadianceQuality(level='poor', text='no image can be read')
    """
    readable = [view for view in views if not view.unreadable]
    if not readable:
        return RadianceQuality("poor", "no image can be read")
    clipped = float(np.mean([view.clipped for view in readable]))
    stops = float(np.median([view.stops for view in readable]))
    figures = f"{stops:.1f} stops on the object, {100 * clipped:.2g} % of it clipped"
    if not hdr:
        held = f"display values (sRGB), {figures}"
        if clipped > CLIPPED_MUCH or "exposure_jump" in defects:
            return RadianceQuality(
                "poor", f"{held}: highlights are lost, so gloss and light cannot be determined"
            )
        return RadianceQuality("limited", f"{held}: colours can be recovered, gloss and light only roughly")
    held = f"linear, {figures}"
    if "few_levels" in defects:
        return RadianceQuality("poor", f"{held}, but made from 8-bit images")
    if "exposure_jump" in defects:
        return RadianceQuality("poor", f"{held}, but with jumps of the exposure")
    if clipped > CLIPPED_MUCH:
        return RadianceQuality("poor", f"{held}, but with clipped highlights")
    if clipped > CLIPPED_A_BIT:
        return RadianceQuality("limited", f"{held}: mark clipped pixels in a validity mask")
    return RadianceQuality("good", f"{held}: good enough for the estimation of materials")
