"""Check that a checkpoint is loaded with the cameras that it was trained with."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.errors import UserError

__all__ = ["check_cameras"]

SAME_PLACE = 1e-3
"""Distance up to which a camera has not moved, scene units."""


def check_cameras(before: Float[Tensor, "V 3"] | None, now: Float[Tensor, "W 3"] | None) -> None:
    """Check that the cameras of a training are where they were; views may have been added or removed.

    Args:
        before: camera positions in the training, scene frame; None if they are not known.
        now: the present ones; None if they are not known.

    Raises:
        UserError: more than half of the cameras of the training have moved.
    """
    if before is None or now is None:
        return
    distance = torch.cdist(before.double(), now.double()).amin(dim=1)
    if (distance > SAME_PLACE).double().mean() > 0.5:
        raise UserError(
            "the training cameras are not where they were, or the scene frame has changed",
            "restore unit and center in capture.json of the run, and the capture's cameras, or train again",
        )
