"""Gains of the photographs: one factor per view and channel, for differences in exposure and white balance.

The logarithms of the gains have mean 0 over the views: a factor per channel that all views share cannot be
separated from the light.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from neilfpp_method.shading.color import at_common_exposure

__all__ = ["PhotographGains", "at_mean_exposure"]


class PhotographGains(nn.Module):
    """Natural logarithms of the gains as parameters.

    Args:
        start: initial log gains; their mean over the views is subtracted.
    """

    def __init__(self, start: Float[Tensor, "V 3"]) -> None:
        super().__init__()
        self.log_gain = nn.Parameter(start - start.mean(0))
        self.register_buffer("start", start - start.mean(0))

    def logarithms(self) -> Float[Tensor, "V 3"]:
        """Log gains of all views, with their mean over the views subtracted."""
        return self.log_gain - self.log_gain.mean(0)

    def forward(self, view: Int[Tensor, " N"]) -> Float[Tensor, "N 3"]:
        """Gains by which the cameras of the given views multiplied radiance."""
        return self.logarithms().exp()[view]

    def drift(self) -> Float[Tensor, "V 3"]:
        """Difference of the log gains from their initial values."""
        return self.logarithms() - self.start


@torch.no_grad()
def at_mean_exposure(
    gains: PhotographGains | None, color: Float[Tensor, "N 3"], view: Int[Tensor, " N"], response: str
) -> Float[Tensor, "N 3"]:
    """Pixel values as at the mean exposure of the photographs, in the capture's response.

    Args:
        gains: gains of the photographs; if None, pixels are returned unchanged.
        color: pixel values.
        view: index of the view of each pixel.
        response: "linear" or "srgb".
    """
    return color if gains is None else at_common_exposure(color, gains(view), response)
