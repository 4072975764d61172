"""The picture `summary.png`: cameras and points from two sides, and the reprojection error of each image."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64, UInt8
from PIL import Image, ImageDraw

from neilfpp_method.data.cameras.camera import Camera
from neilfpp_method.data.files.images import write_png
from neilfpp_method.data.point_cloud import WorldPoints
from neilfpp_method.data.views import Normalization, View
from neilfpp_method.drawing.ink import INK, PALE_INK, PAPER, write
from neilfpp_method.prepare.summary import Placement

__all__ = ["draw_fit", "draw_scene", "write_picture"]

TRAIN, TEST, MISSING = (42, 92, 170), (222, 128, 20), (190, 40, 50)
"""sRGB colours of training cameras, of test cameras, and of images without a pose."""

PANEL, MARGIN = 720, 40
"""Side of each view of the scene, and the margin around it, in pixels."""

TITLE, NOTE, LABEL = 24, 16, 11
"""Sizes of text, in pixels."""

SUPERSAMPLING = 2
"""Factor by which the scene is drawn larger and then scaled down: Pillow draws without antialiasing."""

MAX_POINTS = 40_000
"""Largest number of points that are drawn; more of them are not distinguishable and take seconds."""

PYRAMID_SIZE = 0.18
"""Half the larger extent of the base of a camera's pyramid, in radii of the scene's sphere."""

CHART_HEIGHT, AXIS_HEIGHT = 190, 60
"""Height of the chart of reprojection errors and of the space below it for labels, in pixels."""

TICK = 0.5
"""Distance of the grid lines of the chart, in pixels of reprojection error."""

LABEL_SPACING = 34
"""Smallest distance between two labels of images below the chart, in pixels."""
LABEL_LETTERS = 8
"""Largest number of letters of such a label."""


def write_picture(
    path: Path,
    views: Sequence[View],
    test: Collection[str],
    points: WorldPoints,
    box: Normalization,
    placed: Sequence[Placement],
) -> None:
    """Write the picture as PNG; without the chart of errors if the poses came with the images."""
    parts = [draw_scene(views, test, points, box)]
    if placed:
        parts.append(draw_fit(placed, parts[0].shape[1]))
    write_png(path, np.concatenate(parts))


def draw_scene(
    views: Sequence[View], test: Collection[str], points: WorldPoints, box: Normalization
) -> UInt8[np.ndarray, "H W 3"]:
    """Draw cameras as pyramids, points coloured by their normals, and the scene's sphere, from two sides.

    Args:
        views: views in the world frame, whose +z is drawn upwards.
        test: names of the test views, which have another colour.
        points: the point cloud in the world frame; may be empty.
        box: centre and radius of the scene's sphere.
    """
    pyramids = np.stack([_pyramid(view.camera, box.scale) for view in views])
    center = np.array(box.center)
    reach = 1.08 * float(np.abs(pyramids - center).max(initial=1.2 * box.scale))
    rows = np.random.default_rng(0).permutation(len(points.position))[:MAX_POINTS]
    sheet = Image.new("RGB", (2 * PANEL + 3 * MARGIN, PANEL + 2 * MARGIN + TITLE), PAPER)
    sides = {"from above": (0, 1, 2), "from the side": (0, 2, 1)}
    for i, (title, (right, up, depth)) in enumerate(sides.items()):
        # Far points are drawn first. The side view looks along +y, so near points have a small y.
        flip = -1.0 if title == "from the side" else 1.0
        order = rows[np.argsort(flip * points.position[rows, depth])]
        panel = Image.new("RGB", (SUPERSAMPLING * PANEL, SUPERSAMPLING * PANEL), PAPER)
        draw = ImageDraw.Draw(panel)
        project = _Projection(center[[right, up]], reach, right, up)
        circle = project(center) + np.array([[-1.0], [1.0]]) * SUPERSAMPLING * PANEL / 2 * box.scale / reach
        draw.ellipse([*map(float, circle.reshape(-1))], outline=PALE_INK, width=SUPERSAMPLING)
        colors = np.rint(127.5 * (points.normal[order] + 1.0)).astype(np.uint8)
        for (x, y), color in zip(project(points.position[order]), colors, strict=True):
            draw.rectangle([x - 1, y - 1, x + 1, y + 1], fill=tuple(map(int, color)))
        for view, pyramid in zip(views, pyramids, strict=True):
            eye, *corners = [tuple(map(float, corner)) for corner in project(pyramid)]
            color = TEST if view.name in test else TRAIN
            draw.line([*corners, corners[0]], fill=color, width=SUPERSAMPLING)
            for corner in corners:
                draw.line([eye, corner], fill=color, width=SUPERSAMPLING)
        left = MARGIN + i * (PANEL + MARGIN)
        sheet.paste(panel.resize((PANEL, PANEL), Image.Resampling.LANCZOS), (left, MARGIN + TITLE))
        write(ImageDraw.Draw(sheet), (left, MARGIN // 2), title, TITLE)
    write(ImageDraw.Draw(sheet), (2 * PANEL - 380, MARGIN // 2 + 6), "training cameras", NOTE, TRAIN)
    write(ImageDraw.Draw(sheet), (2 * PANEL - 210, MARGIN // 2 + 6), "test cameras", NOTE, TEST)
    write(ImageDraw.Draw(sheet), (2 * PANEL - 110, MARGIN // 2 + 6), "points, coloured by normal", NOTE, INK)
    return np.asarray(sheet)


def draw_fit(placed: Sequence[Placement], width: int) -> UInt8[np.ndarray, "H W 3"]:
    """Draw the reprojection error of each image as a bar; images without a pose get a full red bar."""
    sheet = Image.new("RGB", (width, CHART_HEIGHT + AXIS_HEIGHT + MARGIN), PAPER)
    draw = ImageDraw.Draw(sheet)
    write(draw, (MARGIN, 0), "reprojection error of each image, pixels", NOTE)
    errors = [p.error for p in placed if p.error is not None]
    top = max(TICK, TICK * np.ceil(max(errors, default=TICK) / TICK))
    base, height = CHART_HEIGHT + 24, CHART_HEIGHT - 10
    for value in np.arange(0.0, top + TICK / 2, TICK):
        y = base - height * value / top
        draw.line([(2 * MARGIN, y), (width - MARGIN, y)], fill=PALE_INK)
        write(draw, (MARGIN, int(y) - 9), f"{value:.1f}", NOTE)
    step = (width - 3 * MARGIN) / len(placed)
    label_every = max(1, -(-LABEL_SPACING // max(int(step), 1)))
    for i, placement in enumerate(placed):
        left = 2 * MARGIN + i * step
        share, color = (1.0, MISSING) if placement.error is None else (placement.error / top, TRAIN)
        draw.rectangle([left + 0.15 * step, base - height * share, left + 0.85 * step, base], fill=color)
        if i % label_every == 0:
            write(draw, (int(left), base + 6), _short(placement.name), LABEL)
    return np.asarray(sheet)


def _short(name: str) -> str:
    """The end of a name; the ends of the names of photographs differ."""
    return name if len(name) <= LABEL_LETTERS else "…" + name[1 - LABEL_LETTERS :]


class _Projection:
    """Orthographic projection of world positions to the pixels of a panel, along a world axis."""

    def __init__(self, center: Float64[np.ndarray, " 2"], reach: float, right: int, up: int) -> None:
        self._axes, self._center, self._scale = [right, up], center, SUPERSAMPLING * PANEL / 2 / reach

    def __call__(self, points: Float64[np.ndarray, "*N 3"]) -> Float64[np.ndarray, "*N 2"]:
        plane = (points[..., self._axes] - self._center) * self._scale * np.array([1.0, -1.0])
        return plane + SUPERSAMPLING * PANEL / 2


def _pyramid(camera: Camera, scale: float) -> Float64[np.ndarray, "5 3"]:
    """The centre of a camera and the four corners of its image, in the world frame."""
    corners = np.array(
        [[0, 0], [camera.width, 0], [camera.width, camera.height], [0, camera.height]], dtype=np.float64
    )
    rays = np.pad(
        (corners - camera.intrinsics[2:]) / camera.intrinsics[:2], ((0, 0), (0, 1)), constant_values=1.0
    )
    rays *= PYRAMID_SIZE * scale / np.abs(rays[:, :2]).max()
    return np.concatenate([np.zeros((1, 3)), rays]) @ camera.c2w[:, :3].T + camera.c2w[:, 3]
