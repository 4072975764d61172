"""Fit motions of cameras to their photographs, with geometry and radiance fixed: direct image alignment.

For each chosen pixel three rays are rendered, on a narrow cone around the ray of the pixel. Their mean is the
rendered value of the pixel, and their differences give its gradient g with respect to the direction d of the
ray. If the camera turns by ω and moves by δ, the pixel looks at what lies in the direction d + ω × d + δ/t,
where t is the distance of the surface. So its value changes by ω · (d × g) + δ · g/t, and Gauss-Newton steps
fit ω and δ to the photograph (Lucas and Kanade 1981). Derivatives of the host are not needed, and the width
of the cone makes fits converge from errors of about two pixels.

Values are compared as sRGB, also those of linear captures, so that highlights do not dominate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from neilfpp_method.fields.poses import PoseMotion
from neilfpp_method.model import NeilfModel
from neilfpp_method.shading.color import CLIPPED, linear_to_srgb
from neilfpp_method.shading.frame import local_frame
from neilfpp_method.structures import PixelBatch, RayBatch

__all__ = ["fit_poses", "pixel_errors"]

MIDDLE_GRAY = 0.18
"""Linear value to which the median radiance of a linear capture is brought before it is encoded as sRGB."""
CONE_RAYS = 3
"""Rays per pixel."""
RAYS_AT_ONCE = 1536
"""Maximum number of rays that are rendered at once; it bounds memory."""
TYPICAL_CORRECTION = 0.01
"""Standard deviation of the prior on each component of a correction: radians, and scene units. A turn and a
shift move an object in the image alike; the prior keeps their difference from growing.
"""
INDEPENDENT_SAMPLES = 0.1
"""Number of independent samples per pixel. The errors of G and R are alike in neighbouring pixels."""
MIN_ERROR = 1e-4
"""Lower bound on the typical error of a pixel, sRGB."""


@dataclass(frozen=True)
class _Rendered:
    """Rendered values of N pixels and their derivatives by the motion (ω, δ) of the camera."""

    value: Float[Tensor, "N 3"]
    slope: Float[Tensor, "N 3 6"]


@torch.no_grad()
def fit_poses(
    model: NeilfModel, given: PixelBatch, start: PoseMotion, pixel: Float[Tensor, " V"]
) -> PoseMotion:
    """Improve the motions of cameras by a Gauss-Newton step, with weights that limit the effect of outliers.

    Args:
        model: the model, in evaluation mode.
        given: pixels with their rays before any motion.
        start: the motions so far. A camera without pixels keeps its motion.
        pixel: angle that a pixel of each view covers, radians.
    """
    rendered = _render(model, start.of(given), pixel)
    off = _photograph(model, given) - rendered.value
    size = off.abs().mean(-1)
    typical = size.median().clamp_min(MIN_ERROR)
    weight = typical / size.clamp_min(typical)
    if model.facts.response == "srgb":
        weight = torch.where(given.color.amax(-1) >= CLIPPED, 0.0, weight)
    step = _solve(rendered.slope, off / typical, weight * INDEPENDENT_SAMPLES, given.view, start, typical)
    return PoseMotion(start.rotation + step[:, :3], start.shift + step[:, 3:])


@torch.no_grad()
def pixel_errors(
    model: NeilfModel, given: PixelBatch, motion: PoseMotion, pixel: Float[Tensor, " V"]
) -> Float[Tensor, " N"]:
    """Mean absolute error of the rendered value of each pixel after a motion, sRGB; see `fit_poses`."""
    value = _render(model, motion.of(given), pixel).value
    return (value - _photograph(model, given)).abs().mean(-1)


def _solve(
    slope: Float[Tensor, "N 3 6"],
    off: Float[Tensor, "N 3"],
    weight: Float[Tensor, " N"],
    view: Int[Tensor, " N"],
    start: PoseMotion,
    typical: Float[Tensor, ""],
) -> Float[Tensor, "V 6"]:
    """The step that minimises the weighted squares of the errors, in units of `typical`, and the prior."""
    slope, off, weight = slope.double() / typical, off.double(), weight.double()
    before = torch.cat((start.rotation, start.shift), -1).double()
    matrix = torch.eye(6).to(before).repeat(len(before), 1, 1) / TYPICAL_CORRECTION**2
    right = -before / TYPICAL_CORRECTION**2
    matrix.index_add_(0, view, torch.einsum("nci,ncj,n->nij", slope, slope, weight))
    right.index_add_(0, view, torch.einsum("nci,nc,n->ni", slope, off, weight))
    step = torch.linalg.solve(matrix, right)
    has_pixels = torch.bincount(view, minlength=len(before)) > 0
    return torch.where(has_pixels[:, None], step, 0.0).to(start.rotation)


def _render(model: NeilfModel, batch: PixelBatch, pixel: Float[Tensor, " V"]) -> _Rendered:
    """Render the cones of pixels."""
    directions, radius = batch.directions, pixel[batch.view, None, None].to(batch.directions)
    turn = torch.arange(CONE_RAYS).to(directions) * (2 * math.pi / CONE_RAYS)
    circle = torch.stack((turn.cos(), turn.sin()), -1)
    aside = torch.einsum("kj,nji->nki", circle, local_frame(directions)[:, :2])
    cone = torch.nn.functional.normalize(directions[:, None] + radius * aside, dim=-1).reshape(-1, 3)
    rays = RayBatch(batch.origins.repeat_interleave(CONE_RAYS, 0), cone)
    view, colors, distances = batch.view.repeat_interleave(CONE_RAYS), [], []
    for first in range(0, len(cone), RAYS_AT_ONCE):
        rows = slice(first, first + RAYS_AT_ONCE)
        part = rays[rows]
        hits = model.host.render(part)
        color = hits.color if model.gains is None else hits.color * model.gains(view[rows])
        colors.append(_encode(model, color))
        # A ray that misses the scene shows the background, which is far away.
        far = part.origins.norm(dim=-1) + model.config.background.radius
        distance = ((hits.position - part.origins) * part.directions).sum(-1)
        distances.append(torch.where(hits.opacity > 0.5, distance, far))
    color = torch.cat(colors).view(-1, CONE_RAYS, 3)
    # At an outline the nearer surface moves in the image.
    distance = torch.cat(distances).view(-1, CONE_RAYS).amin(1)[:, None, None]
    gradient = torch.einsum("nkc,nki->nci", color, aside) * (2 / CONE_RAYS) / radius
    turned = torch.linalg.cross(directions[:, None].expand_as(gradient), gradient)
    return _Rendered(color.mean(1), torch.cat((turned, gradient / distance), -1))


def _encode(model: NeilfModel, radiance: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
    """Display values of radiance, without clipping at the top."""
    linear = model.facts.response == "linear"
    exposure = MIDDLE_GRAY / model.facts.median_radiance if linear else 1.0
    return linear_to_srgb(exposure * radiance.clamp_min(0))


def _photograph(model: NeilfModel, batch: PixelBatch) -> Float[Tensor, "N 3"]:
    """The values of the pixels, as `_encode` encodes them."""
    return _encode(model, batch.color) if model.facts.response == "linear" else batch.color
