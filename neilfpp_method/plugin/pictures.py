"""Figures and pictures of one view for nerfstudio's logs, viewer and `ns-eval`."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from jaxtyping import Bool, Float
from nerfstudio.utils import colormaps
from torch import Tensor

from neilfpp_method.evaluate.metrics import psnr, ssim
from neilfpp_method.plugin.datamanager import VALID
from neilfpp_method.shading.color import display_values, tone_map

__all__ = ["material_pictures", "view_figures", "view_pictures"]


def view_figures(
    outputs: Mapping[str, Tensor], batch: Mapping[str, Tensor], response: str
) -> dict[str, float]:
    """PSNR and SSIM of the display values on the valid pixels of the object, as in `neilfpp eval`.

    Args:
        outputs: outputs of `NeilfMethod` for the view, (H, W, C) each.
        batch: image and loss inputs of the view (`CaptureDataset`), (H, W, C) each, on the same device.
        response: what the image and the colours of the outputs hold: "linear" or "srgb".

    Returns:
        `psnr` and `ssim` of the PBR image, `volume_psnr` and `volume_ssim` of the volume-rendered image.
    """
    image, mask = display_values(batch["image"], response).cpu().numpy(), _counted(outputs, batch)
    figures = {}
    for prefix, name in (("", "rgb"), ("volume_", "rgb_volume")):
        rendered = display_values(outputs[name], response).cpu().numpy()
        figures[f"{prefix}psnr"] = psnr(rendered, image, mask)
        figures[f"{prefix}ssim"] = ssim(rendered, image, mask)
    return figures


def view_pictures(
    outputs: Mapping[str, Tensor], batch: Mapping[str, Tensor], response: str
) -> dict[str, Float[Tensor, "H _ 3"]]:
    """Display values of images and geometry by name; `img` shows the photograph beside the PBR image.

    Args:
        outputs: outputs of `NeilfMethod` for the view, (H, W, C) each.
        batch: image and loss inputs of the view (`CaptureDataset`), (H, W, C) each, on the same device.
        response: what the image and the colours of the outputs hold: "linear" or "srgb".
    """
    accumulation = outputs["accumulation"]
    sides = [display_values(image, response) for image in (batch["image"], outputs["rgb"])]
    return {
        "img": torch.cat(sides, dim=1),
        "rgb_volume": display_values(outputs["rgb_volume"], response),
        "normal": 0.5 * (outputs["normal"] + 1.0) * accumulation,
        "depth": colormaps.apply_depth_colormap(outputs["depth"], accumulation),
        "accumulation": accumulation.expand(-1, -1, 3),
    }


def material_pictures(outputs: Mapping[str, Tensor]) -> dict[str, Float[Tensor, "H W 3"]]:
    """Display values of material and light of a view by name, from outputs as for `view_pictures`."""
    colors = {name: tone_map(outputs[name]) for name in ("base_color", "incident_light")}
    return colors | {name: outputs[name].expand(-1, -1, 3) for name in ("roughness", "metallic")}


def _counted(outputs: Mapping[str, Tensor], batch: Mapping[str, Tensor]) -> Bool[np.ndarray, "H W"]:
    """Valid pixels on the object; without a mask, those on which the rendering shows it."""
    on_object = batch["object_mask"] if batch["mask_known"].any() else outputs["accumulation"]
    return ((on_object > 0.5) & batch[VALID])[..., 0].cpu().numpy()
