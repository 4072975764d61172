"""The start of trainings with tiny fields: a coarse hull and a short fit, instead of seconds for each.

A field of the tiny settings cannot represent a finer hull. Larger fields start as they do outside of tests.
"""

from __future__ import annotations

import functools

import pytest

from neilfpp_method.data.capture import Capture
from neilfpp_method.data.hulls.cloud_hull import find_cloud_hull
from neilfpp_method.data.hulls.visual_hull import find_hull
from neilfpp_method.hosts.volsdf import VolSdfHost
from neilfpp_method.model import NeilfModel
from neilfpp_method.settings.types import NeilfConfig
from neilfpp_method.train import start
from neilfpp_method.train.start import GeometryStart

TINY_WIDTH = 16
"""Width of the distance field in the tiny settings."""


def make_coarse(patch: pytest.MonkeyPatch) -> None:
    """Use a coarser hull and a shorter fit, sufficient for tiny fields."""
    patch.setattr(start, "find_hull", functools.partial(find_hull, resolution=40))
    patch.setattr(start, "find_cloud_hull", functools.partial(find_cloud_hull, resolution=40))
    patch.setattr(start, "STEPS", 200)
    patch.setattr(start, "POINTS", 512)
    patch.setattr(start, "POOL", 8192)


def start_geometry(model: NeilfModel, capture: Capture, config: NeilfConfig) -> GeometryStart | None:
    """`train.start.start_geometry`, short for tiny fields."""
    with pytest.MonkeyPatch.context() as patch:
        if isinstance(model.host, VolSdfHost) and config.host.sdf.width <= TINY_WIDTH:
            make_coarse(patch)
        return start.start_geometry(model, capture, config)
