"""A preview picture at the end of each stage: a photograph next to the renderings of the same view."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from neilfpp_method.data.cameras.projection import camera_rays
from neilfpp_method.data.capture import Capture
from neilfpp_method.data.files.images import write_png
from neilfpp_method.data.pixels.view_pixels import read_colors
from neilfpp_method.data.scaling import file_size, scaled_view
from neilfpp_method.data.views import View
from neilfpp_method.model import EVAL_RAYS, NeilfModel
from neilfpp_method.schedule import Stage
from neilfpp_method.shading.color import display_values, tone_map
from neilfpp_method.structures import RayBatch

__all__ = ["preview_pixels", "write_preview"]

MAX_SIDE = 160
"""Longest side of a panel, in pixels."""


def write_preview(model: NeilfModel, capture: Capture, stage: Stage, path: Path) -> np.ndarray:
    """Render a small preview of the first test view, or of the first training view if there is no test view.

    The panels from left to right are photograph, R and normals; in a stage that trains material also PBR
    rendering, base colour, roughness and metallic.

    Args:
        model: the model, in evaluation mode.
        capture: the capture.
        stage: the stage that has just ended.
        path: the PNG file to write.

    Returns:
        The picture, (H, W, 3) uint8.
    """
    view = _small_view(capture)
    shape = (view.camera.height, view.camera.width, 3)
    panels = [_photograph(view, capture.hdr, model.facts.response)]
    rays = camera_rays(capture.scene_camera(view))
    panels += [p.reshape(shape) for p in _panels(model, rays, model.stages[stage].trains_material)]
    picture = np.concatenate([(p.clip(0.0, 1.0) * 255.0 + 0.5).astype(np.uint8) for p in panels], axis=1)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_png(path, picture)
    return picture


def preview_pixels(capture: Capture) -> int:
    """How many pixels a panel of the picture has."""
    camera = _small_view(capture).camera
    return camera.width * camera.height


def _small_view(capture: Capture) -> View:
    view = (capture.test_views or capture.train_views)[0]
    return scaled_view(view, min(1.0, MAX_SIDE / max(file_size(view))))


def _photograph(view: View, hdr: bool, response: str) -> np.ndarray:
    return display_values(torch.from_numpy(read_colors(view, hdr)), response).numpy()


def _panels(model: NeilfModel, rays: RayBatch, with_material: bool) -> list[np.ndarray]:
    device, render = next(model.parameters()).device, model.maps if with_material else model.host_maps
    chunks = [render(rays[i : i + EVAL_RAYS].to(device)) for i in range(0, len(rays), EVAL_RAYS)]

    def joined(name: str) -> Tensor:
        return torch.cat([getattr(chunk, name) for chunk in chunks]).float().cpu()

    panels = [tone_map(joined("rgb_volume")), (joined("normal") + 1.0) / 2.0 * joined("opacity")]
    if with_material:
        panels += [tone_map(joined("rgb")), joined("base_color")]
        panels += [joined(name).expand(-1, 3) for name in ("roughness", "metallic")]
    return [panel.numpy() for panel in panels]
