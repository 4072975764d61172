"""What `ns-export` needs of a model besides its outputs: colours to store, and a distance field."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.shading.color import display_values, tone_map

__all__ = ["DistanceField", "stored_colors"]

AS_PHOTOGRAPHED = ("rgb", "rgb_volume")
"""Outputs in the response of the capture."""
LINEAR = ("base_color", "incident_light")
"""Outputs of linear colours."""


@dataclass(frozen=True)
class DistanceField:
    """A distance with the interface of nerfstudio's `SDFField`, from which `ns-export` extracts a mesh.

    Attributes:
        distance: signed distance at points (P, 3) of the scene frame, (P,), negative inside.
    """

    distance: Callable[[Tensor], Tensor]

    def forward_geonetwork(self, inputs: Float[Tensor, "P 3"]) -> Float[Tensor, "P 1"]:
        """The distance as the first column; `SDFField` has features in the others."""
        return self.distance(inputs)[:, None]


def stored_colors(outputs: Mapping[str, Tensor], name: str, response: str) -> Float[Tensor, "... 4"]:
    """Display values of an output in [0, 1], as clouds and textures of 8 bits hold them, and the opacity.

    Args:
        outputs: outputs of `NeilfMethod`, (..., C) each.
        name: the output; one channel becomes grey.
        response: what `rgb` and `rgb_volume` hold: "linear" or "srgb".
    """
    values, opacity = outputs[name], outputs["accumulation"]
    if name in AS_PHOTOGRAPHED:
        values = display_values(values, response)
    elif name in LINEAR:
        values = tone_map(values)
    return torch.cat((values.clamp(0, 1).expand(*opacity.shape[:-1], 3), opacity), dim=-1)
