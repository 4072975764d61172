"""What a model shows at some training pixels: is there a surface, and is its material within bounds?"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from neilfpp_method.model import NeilfModel
from neilfpp_method.structures import Material, PixelBatch, SurfaceHits

__all__ = ["Look", "look", "look_at_hits"]

OPAQUE = 0.5
"""Opacity above which a ray shows something."""
AT_BOUND = 0.02
"""Distance from 0 or 1 within which a parameter of the material counts as at its bound."""


@dataclass(frozen=True)
class Look:
    """Shares between 0 and 1.

    Attributes:
        rays: how many pixels on the object, as far as masks tell, were looked at.
        opaque: share of them that show something.
        sharp: share of the opaque ones that meet one surface rather than fog or the mean of several surfaces.
        at_bound: share of the surface points whose base colour is within 0.02 of 0 or of 1 in every channel;
            none without a material.
    """

    rays: int
    opaque: float
    sharp: float
    at_bound: float | None


@torch.no_grad()
def look(model: NeilfModel, pixels: PixelBatch, with_material: bool) -> Look:
    """Render pixels of training views; the model stays in the mode that it is in.

    Args:
        model: on any host.
        pixels: on the device of the model.
        with_material: whether the stage has a material to look at.
    """
    mode = model.training
    model.eval()
    seen = look_at_hits(
        model, model.host.render(pixels[torch.nonzero(pixels.mask > 0.5)[:, 0]].rays), with_material
    )
    model.train(mode)
    return seen


@torch.no_grad()
def look_at_hits(model: NeilfModel, hits: SurfaceHits, with_material: bool) -> Look:
    """As `look`, of pixels on the object that the host has rendered already."""
    opaque = hits.opacity > OPAQUE
    sharp = opaque & hits.is_hit(model.config.shading.hit_share)
    at_bound = None
    if with_material and sharp.any():
        at_bound = _share_at_bound(model.materials(hits.position[sharp]))
    return Look(len(hits), _share(opaque), _share(sharp[opaque]), at_bound)


def _share(flags: torch.Tensor) -> float:
    return flags.float().mean().item() if len(flags) else 0.0


def _share_at_bound(material: Material) -> float:
    color = material.base_color
    return ((color < AT_BOUND) | (color > 1 - AT_BOUND)).all(-1).float().mean().item()
