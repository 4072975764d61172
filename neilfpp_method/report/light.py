"""The light of a run for its page: the map as a picture, and its lamps."""

from __future__ import annotations

from typing import Any

import numpy as np

from neilfpp_method.evaluate.pictures import auto_exposure, display_color
from neilfpp_method.export.light import lamps_in_world
from neilfpp_method.fields.environment import EnvironmentLight
from neilfpp_method.report.encoded import encoded
from neilfpp_method.train.run import Run

__all__ = ["lamps_of", "picture_of_map"]

MIN_HEIGHT = 192
"""Pixels of the picture: each texel is so large that it is seen."""


def picture_of_map(run: Run) -> tuple[str, float] | None:
    """The environment map as a data address, +z at the top, and its exposure; none without a map."""
    light = run.model.light
    if not run.has_material or not isinstance(light, EnvironmentLight):
        return None
    radiance = light.log_radiance.detach().exp().permute(1, 2, 0).cpu().numpy()
    exposure = auto_exposure(radiance.reshape(-1, 3))
    times = max(1, -(-MIN_HEIGHT // len(radiance)))
    return encoded(np.kron(display_color(radiance, exposure), np.ones((times, times, 1), np.uint8))), exposure


def lamps_of(run: Run) -> list[dict[str, Any]]:
    """The lamps as `lamps.json` has them; none before a stage has moved the light."""
    return lamps_in_world(run) if run.has_material else []
