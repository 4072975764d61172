"""Images for display: maps in 8 bits, and incident light in latitude-longitude projection.

Pure functions on arrays. Metrics never read these images.
"""

from __future__ import annotations

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8

from neilfpp_method.data.kd_tree import kd_tree
from neilfpp_method.drawing.ink import PAPER
from neilfpp_method.shading.color import luminance, tone_map

__all__ = [
    "auto_exposure",
    "cut_out",
    "display",
    "display_color",
    "display_depth",
    "display_error",
    "lat_long_directions",
    "nearest_radiance",
    "ring",
]

# ------------------------------------------------------------------------------------------------------- maps


def display(name: str, values: Float[np.ndarray, "H W C"]) -> UInt8[np.ndarray, "H W C"]:
    """Convert a map to 8 bits, according to its name in `structures.Maps`.

    Normals become colours, depth is normalised to its 2nd and 98th percentile, other maps with one channel
    are grey, and colours are tone-mapped. Depths that are not finite belong to no surface: they are black and
    do not count in the range.
    """
    if name == "normal":
        return _to_bytes(0.5 * (values + 1.0))
    if name == "depth":
        finite = values[np.isfinite(values)]
        return display_depth(values, *(np.percentile(finite, [2, 98]) if finite.size else (0.0, 1.0)))
    return _to_bytes(values) if values.shape[-1] == 1 else display_color(values)


def display_color(radiance: Float[np.ndarray, "H W 3"], exposure: float = 1.0) -> UInt8[np.ndarray, "H W 3"]:
    """Multiply linear RGB by the exposure, clip to [0, 1] and encode as sRGB."""
    scaled = torch.from_numpy(np.asarray(radiance * exposure, dtype=np.float32))
    return _to_bytes(tone_map(scaled).numpy())


def display_depth(depth: Float[np.ndarray, "H W 1"], near: float, far: float) -> UInt8[np.ndarray, "H W 1"]:
    """Convert depth to grey, white at `near` and black at `far`; pixels without depth are black."""
    return _to_bytes((far - np.where(np.isfinite(depth), depth, far)) / max(far - near, 1e-6))


def display_error(error: Float[np.ndarray, "H W"], largest: float) -> UInt8[np.ndarray, "H W 3"]:
    """Convert errors to colours: black at 0, through red to pale yellow at `largest` and above."""
    return cv2.applyColorMap(_to_bytes(error / largest), cv2.COLORMAP_INFERNO)[..., ::-1]


def cut_out(
    picture: UInt8[np.ndarray, "H W C"],
    mask: Bool[np.ndarray, "H W"],
    background: tuple[int, int, int] = PAPER,
) -> UInt8[np.ndarray, "H W 3"]:
    """Replace the pixels outside of the mask by a background colour."""
    rgb = np.broadcast_to(picture, (*mask.shape, 3))
    return np.where(mask[..., None], rgb, np.array(background, dtype=np.uint8))


def _to_bytes(values: Float[np.ndarray, "*shape"]) -> UInt8[np.ndarray, "*shape"]:
    return np.rint(np.clip(np.nan_to_num(values), 0.0, 1.0) * 255.0).astype(np.uint8)


# --------------------------------------------------------------------------------------------- incident light


def lat_long_directions(height: int) -> Float[np.ndarray, "height W 3"]:
    """Unit directions of the pixels of a latitude-longitude image of width W = 2 · height.

    Row j has θ = π (j + ½)/height from +z and column i has φ = 2π (i + ½)/W; the direction is
    (sin φ sin θ, cos φ sin θ, cos θ).
    """
    theta = np.pi * (np.arange(height) + 0.5)[:, None] / height
    phi = np.pi * (np.arange(2 * height) + 0.5)[None] / height
    axes = (np.sin(phi) * np.sin(theta), np.cos(phi) * np.sin(theta), np.cos(theta) * np.ones_like(phi))
    return np.stack(axes, axis=-1).astype(np.float32)


def nearest_radiance(
    wi: Float[np.ndarray, "S 3"], radiance: Float[np.ndarray, "S 3"], directions: Float[np.ndarray, "H W 3"]
) -> Float[np.ndarray, "H W 3"]:
    """Look up radiance that is known along `wi` in other directions, by the nearest neighbour."""
    return radiance[kd_tree(wi).query(directions.reshape(-1, 3))[1]].reshape(directions.shape)


def ring(
    picture: UInt8[np.ndarray, "H W 3"],
    directions: Float[np.ndarray, "K 3"],
    color: tuple[int, int, int] = (255, 64, 64),
) -> UInt8[np.ndarray, "H W 3"]:
    """Draw rings around unit directions into a copy of a latitude-longitude image.

    Pixels correspond to directions as in `lat_long_directions`.
    """
    height, width, _ = picture.shape
    marked = np.ascontiguousarray(picture).copy()
    for x, y, z in directions:
        column = np.arctan2(x, y) / (2 * np.pi) % 1 * width
        row = np.arccos(np.clip(z, -1, 1)) / np.pi * height
        cv2.circle(marked, (int(column), int(row)), max(2, height // 20), color, 1, cv2.LINE_AA)
    return marked


def auto_exposure(radiance: Float[np.ndarray, "P 3"]) -> float:
    """The factor that scales the 90th percentile of luminance to 0.7; 1 if there is no radiance.

    Brighter values, such as those of lamps, may clip.
    """
    if not len(radiance):
        return 1.0
    level = np.percentile(luminance(torch.from_numpy(np.asarray(radiance, dtype=np.float32))).numpy(), 90)
    return 0.7 / max(float(level), 1e-6)
