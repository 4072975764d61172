"""The light of a run for its report: the environment map as an image, and the lamps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from neilfpp_method.evaluate.pictures import auto_exposure, display_color
from neilfpp_method.export.light import lamps_in_world
from neilfpp_method.fields.environment import EnvironmentLight
from neilfpp_method.report.data_urls import image_url
from neilfpp_method.train.run import Run

__all__ = ["MapPicture", "lamps_of", "picture_of_map"]

MIN_HEIGHT = 192
"""Least height of the image, pixels. Texels are enlarged until it is reached, so that they are visible."""


@dataclass(frozen=True)
class MapPicture:
    """The environment map, +z at the top, as a data URL; its radiance is multiplied by `exposure`."""

    picture: str
    exposure: float


def picture_of_map(run: Run) -> MapPicture | None:
    """Draw the environment map.

    Returns None if the run's light is not an environment map, or no stage has estimated the light yet.
    """
    light = run.model.light
    if not run.has_material or not isinstance(light, EnvironmentLight):
        return None
    radiance = light.log_radiance.detach().exp().permute(1, 2, 0).cpu().numpy()
    exposure = auto_exposure(radiance.reshape(-1, 3))
    factor = max(1, -(-MIN_HEIGHT // len(radiance)))
    enlarged = np.kron(display_color(radiance, exposure), np.ones((factor, factor, 1), np.uint8))
    return MapPicture(image_url(enlarged), exposure)


def lamps_of(run: Run) -> list[dict[str, Any]]:
    """The lamps in the format of `lamps.json`; empty if no stage has estimated the light yet."""
    return lamps_in_world(run) if run.has_material else []
