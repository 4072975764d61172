"""From a capture to a model: what the images decide, and the host that the settings ask for."""

from __future__ import annotations

import torch

from neilfpp_method.config import NeilfConfig
from neilfpp_method.data.capture import Capture
from neilfpp_method.data.pixels import PixelDataset
from neilfpp_method.data.point_cloud import load_point_cloud
from neilfpp_method.errors import UserError
from neilfpp_method.hosts.volsdf import VolSdfHost
from neilfpp_method.model import NeilfModel, SceneFacts
from neilfpp_method.structures import OrientedPoints

__all__ = ["build_model", "scene_facts"]

# METHOD §5: the sigmoid of R reaches 1 for LDR and 3 for HDR input; a brighter capture needs more room, and the few
# brightest pixels (a lamp in view) do not set the scale of all others.
LDR_SCALE = 1.0
HDR_SCALE = 3.0
BRIGHT_QUANTILE = 0.999


def scene_facts(capture: Capture, pixels: PixelDataset, config: NeilfConfig) -> SceneFacts:
    """What the training images decide before training; see `SceneFacts`."""
    response = "linear" if capture.hdr else "srgb"
    scale = config.radiance.scale
    if scale is None:
        scale = LDR_SCALE if response == "srgb" else max(HDR_SCALE, pixels.radiance_quantile(BRIGHT_QUANTILE))
    kind, color = config.background.kind, config.background.color
    if color is None and kind in ("auto", "constant"):
        border = pixels.border_color()
        color = None if border is None else tuple(border.tolist())
    if kind == "auto":
        kind = "inverted_sphere" if color is None else "constant"
    return SceneFacts(response, pixels.median_radiance(), scale, kind, color or (0.0, 0.0, 0.0))


def build_model(capture: Capture, facts: SceneFacts, config: NeilfConfig) -> NeilfModel:
    """An untrained model for a capture.

    Raises:
        UserError: the settings ask for a point cloud that the capture does not have.
    """
    host = VolSdfHost(config, facts.radiance_scale, facts.background, facts.background_color, _points(capture, config))
    return NeilfModel(host, config, facts)


def _points(capture: Capture, config: NeilfConfig) -> OrientedPoints | None:
    if config.loss.point_cloud == 0.0:
        return None
    if capture.point_cloud is None:
        raise UserError(
            f"{capture.root}: the point-cloud loss is on, and the capture has no oriented point cloud",
            "add inputs/model/oriented_pcd.ply or set --config.loss.point-cloud 0",
        )
    return load_point_cloud(capture.point_cloud, capture.normalisation)
