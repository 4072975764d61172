"""How much brighter each photograph is than the others: a gain for each view and channel.

Exposure is a common factor of the three gains of a view, white balance is what is left. Their logarithms have
the mean 0 over the views: radiance is known up to a factor for each channel anyway, which the light takes.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from neilfpp_method.shading.color import at_common_exposure

__all__ = ["PhotographGains", "at_mean_exposure"]


class PhotographGains(nn.Module):
    """The natural logarithms of the gains, as unknowns.

    Args:
        start: what they start as and are held near; its mean over the views is taken out.
    """

    def __init__(self, start: Float[Tensor, "V 3"]) -> None:
        super().__init__()
        self.log_gain = nn.Parameter(start - start.mean(0))
        self.register_buffer("start", start - start.mean(0))

    def logarithms(self) -> Float[Tensor, "V 3"]:
        """Of all views; the mean over the views is 0, whatever the parameters are."""
        return self.log_gain - self.log_gain.mean(0)

    def forward(self, view: Int[Tensor, " N"]) -> Float[Tensor, "N 3"]:
        """What the cameras of some views, by number, multiplied radiance by."""
        return self.logarithms().exp()[view]

    def drift(self) -> Float[Tensor, "V 3"]:
        """How far the logarithms have come from their start."""
        return self.logarithms() - self.start


@torch.no_grad()
def at_mean_exposure(
    gains: PhotographGains | None, color: Float[Tensor, "N 3"], view: Int[Tensor, " N"], response: str
) -> Float[Tensor, "N 3"]:
    """Pixels of some views, by number, as a photograph of mean exposure would hold them, in the capture's
    response; as they are where there are no gains.
    """
    return color if gains is None else at_common_exposure(color, gains(view), response)
