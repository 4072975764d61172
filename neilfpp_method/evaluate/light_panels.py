"""Images of the incident light at surface points, beside the true light if it is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from neilfpp_method.data.cameras.projection import camera_rays
from neilfpp_method.data.truth import Truth
from neilfpp_method.evaluate.contact_sheet import Group, PictureRow, Section
from neilfpp_method.evaluate.pictures import (
    auto_exposure,
    cut_out,
    display_color,
    lat_long_directions,
    nearest_radiance,
    ring,
)
from neilfpp_method.evaluate.views import RenderedView
from neilfpp_method.export.probes import spread
from neilfpp_method.structures import OrientedPoints
from neilfpp_method.train.run import Run

__all__ = ["light_sections"]

POINTS = 4
"""Number of surface points whose incident light is shown."""
POINTS_PER_SECTION = 2
"""Number of points side by side in one section."""
LIGHT_HEIGHT = 120
"""Height of a latitude-longitude image, pixels."""
SHADE = (232, 232, 229)
"""Colour of directions below the surface, sRGB bytes."""
TINY = 1e-6
"""Least factor by which light is divided."""


@dataclass(frozen=True)
class LightPoint:
    """A surface point, and its true incident radiance as a latitude-longitude image, if known."""

    position: Float[np.ndarray, " 3"]
    normal: Float[np.ndarray, " 3"]
    truth: Float[np.ndarray, "H W 3"] | None


def light_sections(
    run: Run, rendered: Sequence[RenderedView], scale: Float[np.ndarray, " 3"] | None
) -> list[Section]:
    """Sections with the incident light at surface points: truth, estimate, and scaled estimate.

    Images determine only the product of light and base colour. The scaled estimate is therefore divided by
    `scale`, the factor that fits the base colour to the truth (`panels.albedo_scale`). Rings mark the
    directions to the centres of the run's lamps, including lamps that are occluded.

    Args:
        run: the run, with a material.
        rendered: rendered views. If the capture has no true light field, points are chosen on the surface in
            the first view.
        scale: factor per channel of base colour, or None to leave the scaled estimate out.

    Returns:
        The sections; empty if there is neither a light field nor a surface in the first view.
    """
    directions = lat_long_directions(LIGHT_HEIGHT)
    points = _true_points(run, directions) or _rendered_points(run, rendered[0])
    if not points:
        return []
    columns: list[list[np.ndarray]] = [_incident_light(run, points, directions)]
    titles = ["estimate"]
    if scale is not None:
        columns.append([light / np.maximum(scale, TINY) for light in columns[0]])
        titles.append("estimate, scaled")
    if points[0].truth is not None:
        columns.insert(0, [point.truth for point in points])
        titles.insert(0, "truth")
    above = [directions @ point.normal > 0 for point in points]
    exposure = auto_exposure(np.concatenate([light[a] for light, a in zip(columns[0], above, strict=True)]))
    note = f"+z at the top\nexposure {exposure:.2g}"
    sections = []
    for first in range(0, len(points), POINTS_PER_SECTION):
        groups, pictures = [], []
        for i, point in list(enumerate(points))[first : first + POINTS_PER_SECTION]:
            x, y, z = point.position.round(2) + 0.0  # no "-0.00"
            groups.append(Group(f"Light at ({x:.2f}, {y:.2f}, {z:.2f})", tuple(titles)))
            for title, column in zip(titles, columns, strict=True):
                picture = cut_out(display_color(column[i], exposure), above[i], SHADE)
                pictures.append(picture if title == "truth" else ring(picture, _lamps_above(run, point)))
        sections.append(Section(tuple(groups), (PictureRow("Incident light", tuple(pictures), note),)))
    return sections


def _lamps_above(run: Run, point: LightPoint) -> Float[np.ndarray, "K 3"]:
    """Unit directions from a point to the lamps above its tangent plane."""
    lamps = run.model.lamps
    if not lamps.count:
        return np.zeros((0, 3), np.float32)
    offset = lamps.position[: lamps.count].cpu().numpy() - point.position
    offset = offset[offset @ point.normal > 0]
    return offset / np.linalg.norm(offset, axis=-1, keepdims=True)


def _true_points(run: Run, directions: Float[np.ndarray, "H W 3"]) -> list[LightPoint]:
    """Points of the capture's true light field, spread over it; empty if there is no light field."""
    field = Truth(run.capture).light_field()
    if field is None:
        return []
    rows = spread(OrientedPoints(field.position, field.normal), POINTS).tolist()
    position, normal = field.position.numpy(), field.normal.numpy()
    wi, incident = field.wi.numpy(), field.incident.numpy()
    return [
        LightPoint(position[i], normal[i], nearest_radiance(wi[i], incident[i], directions)) for i in rows
    ]


def _rendered_points(run: Run, rendered: RenderedView) -> list[LightPoint]:
    """Surface points of a rendered view, spread from top to bottom; empty if it shows no surface."""
    view = next(view for view in run.capture.views if view.name == rendered.name)
    rays = camera_rays(run.capture.scene_camera(view))
    hits = np.flatnonzero(rendered.surface_mask)
    if not len(hits):
        return []
    rows = hits[np.linspace(0, len(hits) - 1, POINTS + 2).round().astype(int)[1:-1]]
    depth, normal = rendered.maps["depth"].reshape(-1, 1)[rows], rendered.maps["normal"].reshape(-1, 3)[rows]
    position = rays.origins.numpy()[rows] + depth * rays.directions.numpy()[rows]
    return [LightPoint(x, n, None) for x, n in zip(position, normal, strict=True)]


@torch.no_grad()
def _incident_light(
    run: Run, points: Sequence[LightPoint], directions: Float[np.ndarray, "H W 3"]
) -> list[Float[np.ndarray, "H W 3"]]:
    device = run.device
    wi = torch.from_numpy(directions).reshape(1, -1, 3).to(device)
    positions = [torch.as_tensor(point.position, device=device)[None] for point in points]
    return [run.model.incident_light(x, wi).reshape(directions.shape).cpu().numpy() for x in positions]
