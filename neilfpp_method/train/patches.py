"""Give the host the views whose patches it compares (`hosts.patches`)."""

from __future__ import annotations

from neilfpp_method.data.pixels.dataset import PixelDataset
from neilfpp_method.hosts.patches import patch_views
from neilfpp_method.hosts.volsdf import VolSdfHost
from neilfpp_method.model import NeilfModel
from neilfpp_method.schedule import Stage, active_losses

__all__ = ["pose_patches", "show_patches"]


def show_patches(model: NeilfModel, pixels: PixelDataset, stage: Stage) -> None:
    """Show the host the training views in a stage with L_patch; in others, free their memory.

    Args:
        model: the model, on the device of the pixels.
        pixels: the training pixels, with the cameras that are used.
        stage: the stage that begins or continues.
    """
    if isinstance(model.host, VolSdfHost):
        is_active = "patches" in active_losses(stage, model.config, model.stages)
        model.host.patch_views = patch_views(pixels) if is_active else None


def pose_patches(model: NeilfModel, pixels: PixelDataset) -> None:
    """Use the corrected cameras of the training pixels in the comparison of patches."""
    if isinstance(model.host, VolSdfHost) and model.host.patch_views is not None:
        model.host.patch_views.pose([pixels.capture.scene_camera(view) for view in pixels.views])
