"""Places from the surface points of training steps, for training loops without a data set of images.

`effects.places.gather_places` asks a data set for the pixels that show a place. A loop into which NeILF++ is
attached hands over only batches of pixels. If many batches are remembered, most surface points have
neighbours that other views showed, and neighbours together are a place.
"""

from __future__ import annotations

import torch
from torch import nn

from neilfpp_method.effects.places import MIN_COSINE, SAME_NORMAL, Places
from neilfpp_method.lighting.ring import Ring
from neilfpp_method.shading.color import CLIPPED, srgb_to_linear
from neilfpp_method.structures import Observed

__all__ = ["PlaceMemory"]

PIXELS = 12_000
"""Number of remembered pixels, ten per place."""
PLACES = 1200
"""Number of places, as many as `neilfpp train` uses."""
MIN_PIXELS = 4
"""Minimum number of pixels per place: fewer do not distinguish materials."""
FOLDS = 20
"""Number of groups of pixels that stand for views when some are held back."""
MAX_WAIT = 40
"""Steps after which a memory that is not full is used as it is."""


class PlaceMemory(nn.Module):
    """The newest surface points of training steps.

    Args:
        response: response of the pixels, "linear" or "srgb".
    """

    def __init__(self, response: str) -> None:
        super().__init__()
        self.response = response
        self.points = Ring(PIXELS, 12)
        self.steps = 0

    @property
    def is_ready(self) -> bool:
        """Whether there are enough points for an initial light, or no more are to be waited for."""
        return self.points.full or self.steps >= MAX_WAIT

    @torch.no_grad()
    def remember(self, observed: Observed) -> None:
        """Add the surface points of a step, in place of the oldest."""
        usable = (observed.normal * observed.wo).sum(-1) > MIN_COSINE
        pixel = observed.pixel
        if self.response == "srgb":
            usable = usable & (pixel.amax(-1) < CLIPPED)
            pixel = srgb_to_linear(pixel)
        self.points.keep(torch.cat((observed.position, observed.normal, observed.wo, pixel), -1)[usable])
        self.steps += 1

    @torch.no_grad()
    def places(self) -> Places:
        """Group the points: each belongs to the nearest of `PLACES` points drawn at random.

        There are no places before the first point.
        """
        observed = Observed(*self.points.kept().split(3, -1))
        count = len(observed)
        centre = observed[torch.randperm(count, device=observed.position.device)[:PLACES]]
        distance = torch.cdist(observed.position, centre.position)
        place = distance.argmin(1) if count else distance.new_zeros(0, dtype=torch.long)
        same = (observed.normal * centre.normal[place]).sum(-1) > SAME_NORMAL
        fold = torch.arange(count, device=place.device) % FOLDS
        return (
            Places(len(centre), place, fold, observed).where(torch.nonzero(same)[:, 0]).in_views(MIN_PIXELS)
        )
