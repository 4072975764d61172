"""Find the colour of the background behind the scene, which most image borders show.

If the images show the ground under a sky, or a table that extends beyond the images, half of the border has
one colour as well. The views together distinguish these cases: everything that is not background must lie
inside the scene, in the visual hull (Laurentini 1994) of all pixels that do not have the background colour.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64, Int
from torch import Tensor

from neilfpp_method.data.hulls.silhouettes import AGREEMENT, MAX_VIEWS, Outline, agreement
from neilfpp_method.data.pixels.dataset import PixelDataset
from neilfpp_method.data.pixels.store import BORDER_SHARE, border
from neilfpp_method.data.views import Normalization
from neilfpp_method.structures import RayBatch

__all__ = ["border_color", "border_colors", "border_median"]

BORDER_TOLERANCE = 0.02
"""Largest deviation of a background pixel from the background colour, relative to the brighter of that colour
and the median of the object."""
MIN_OTHER_SHARE = 0.01
"""Share of the border pixels up to which other colours do not count: pixels at the outline of an object that
extends beyond the image show a mixture of object and background.
"""
MAX_RAYS = 1000
"""Largest number of rays that are tested."""
POINTS_PER_RAY = 65
"""Number of test points on each ray, evenly spaced inside the sphere around the scene box."""
RADIUS = math.sqrt(3.0)
"""Radius of that sphere, scene units: it passes through the corners of the box."""
MIN_INSIDE_SHARE = 0.9
"""Share of the rays that must have a test point inside the visual hull."""


def border_color(pixels: PixelDataset) -> Float[Tensor, " 3"] | None:
    """Return the linear RGB of the background; None if the image borders have no common colour.

    The background colour is the median of the border, if at least half of the border pixels differ from it by
    at most 2 % of the brighter of that colour and the object's median radiance, and if the other border
    pixels are few or can lie within the scene, which fails if that colour is the ground and the others are
    the sky. Pixels that a mask assigns to the object do not count.
    """
    numbers = border(pixels.store)
    if not len(numbers):
        return None
    colors = pixels.store.colors(numbers, pixels.store.views_of(numbers))
    color = pixels.linear(colors).median(dim=0).values
    tolerance = BORDER_TOLERANCE * max(float(color.max()), pixels.median_radiance())

    def differs(values: Float32[np.ndarray, "N 3"]) -> Bool[Tensor, " N"]:
        return (pixels.linear(values) - color).abs().amax(dim=-1) > tolerance

    others = numbers[differs(colors).numpy()]
    if len(others) > (1 - BORDER_SHARE) * len(numbers):
        return None
    if len(others) <= MIN_OTHER_SHARE * len(numbers):
        return color
    return color if _within_the_scene(pixels, others, differs) else None


def border_median(pixels: PixelDataset) -> Float[Tensor, " 3"]:
    """Return the median linear RGB of the image borders; black if no pixel there is valid."""
    colors = pixels.linear(border_colors(pixels))
    return colors.median(dim=0).values if len(colors) else colors.new_zeros(3)


def border_colors(pixels: PixelDataset) -> Float32[np.ndarray, "B 3"]:
    """Return the stored colours of the valid pixels on the image borders."""
    numbers = border(pixels.store)
    return pixels.store.colors(numbers, pixels.store.views_of(numbers))


def _within_the_scene(
    pixels: PixelDataset,
    numbers: Int[np.ndarray, " N"],
    differs: Callable[[Float32[np.ndarray, "P 3"]], Bool[Tensor, " P"]],
) -> bool:
    """Whether the content of some pixels can lie within the scene.

    Args:
        pixels: the pixels of all views.
        numbers: indices of the pixels that are tested.
        differs: tells which colours differ from that of the background.
    """
    if not len(numbers):
        return True
    step = -(-len(numbers) // MAX_RAYS)
    rays = pixels.numbered(torch.from_numpy(numbers[::step].copy())).rays
    outlines = []
    for i in range(0, len(pixels.views), -(-len(pixels.views) // MAX_VIEWS)):
        view = pixels.views[i]
        inside = differs(pixels.store.view_colors(i)).view(view.camera.height, -1)
        outlines.append(Outline(view, inside.numpy()))
        pixels.store.release()
    return _leaves_room(outlines, rays, pixels.capture.normalization)


def _leaves_room(outlines: Sequence[Outline], rays: RayBatch, normalization: Normalization) -> bool:
    """Return whether the pixels that do not have the background colour can lie within the scene.

    Args:
        outlines: for each view, the pixels without that colour; cameras in the world frame.
        rays: rays through such pixels, in the scene frame.
        normalization: the transformation between the two frames.
    """
    held = agreement(outlines, _places(rays, normalization)).reshape(len(rays), POINTS_PER_RAY)
    return bool((held >= AGREEMENT).any(axis=1).mean() >= MIN_INSIDE_SHARE)


def _places(rays: RayBatch, normalization: Normalization) -> Float64[np.ndarray, "P 3"]:
    """Test points on each ray, world frame; the closest point of a ray that misses the sphere."""
    origins, directions = rays.origins.double().cpu(), rays.directions.double().cpu()
    nearest = -(origins * directions).sum(-1, keepdim=True)
    missed = origins.square().sum(-1, keepdim=True) - nearest.square()
    half = (RADIUS**2 - missed).clamp_min(0.0).sqrt()
    along = nearest + half * torch.linspace(-1.0, 1.0, POINTS_PER_RAY, dtype=half.dtype)
    points = origins[:, None] + along[..., None] * directions[:, None]
    return normalization.to_world(points.reshape(-1, 3)).numpy()
