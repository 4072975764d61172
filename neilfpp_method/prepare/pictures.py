"""A picture of what was found: cameras and points from two sides, and how well each image fits."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64, UInt8
from PIL import Image, ImageDraw, ImageFont

from neilfpp_method.data.images import write_png
from neilfpp_method.data.point_cloud import WorldPoints
from neilfpp_method.data.views import Camera, Normalisation, View
from neilfpp_method.prepare.summary import Placement

__all__ = ["draw_fit", "draw_scene", "write_picture"]

PAPER, INK, PALE = (250, 250, 248), (28, 30, 34), (176, 180, 186)
TRAIN, TEST, BAD = (42, 92, 170), (222, 128, 20), (190, 40, 50)
PANEL, MARGIN, TITLE, NOTE = 720, 40, 24, 16
FINE = 2
MAX_POINTS = 40_000
FRUSTUM = 0.18
FIT_HEIGHT, AXIS, TICK = 190, 60, 0.5


def write_picture(
    path: Path,
    views: Sequence[View],
    test: Collection[str],
    points: WorldPoints,
    box: Normalisation,
    placed: Sequence[Placement],
) -> None:
    """Write the picture as PNG; the fit is left out where poses came with the images."""
    parts = [draw_scene(views, test, points, box)]
    if placed:
        parts.append(draw_fit(placed, parts[0].shape[1]))
    write_png(path, np.concatenate(parts))


def draw_scene(
    views: Sequence[View], test: Collection[str], points: WorldPoints, box: Normalisation
) -> UInt8[np.ndarray, "H W 3"]:
    """Cameras as pyramids, points coloured by normals, and the unit sphere, from above and the side.

    Args:
        views: in the world frame; +z is up in the picture.
        test: the names of the views that are held out, drawn in another colour.
        points: the cloud, in the world frame; may be empty.
        box: the scene box.
    """
    pyramids = np.stack([_pyramid(view.camera, box.scale) for view in views])
    centre = np.array(box.centre)
    reach = 1.08 * float(np.abs(pyramids - centre).max(initial=1.2 * box.scale))
    rows = np.random.default_rng(0).permutation(len(points.position))[:MAX_POINTS]
    sheet = Image.new("RGB", (2 * PANEL + 3 * MARGIN, PANEL + 2 * MARGIN + TITLE), PAPER)
    sides = {"from above": (0, 1, 2), "from the side": (0, 2, 1)}
    for i, (title, (right, up, depth)) in enumerate(sides.items()):
        flip = -1.0 if title == "from the side" else 1.0  # seen along +y, what is near has a small y
        order = rows[np.argsort(flip * points.position[rows, depth])]
        panel = Image.new("RGB", (FINE * PANEL, FINE * PANEL), PAPER)
        draw = ImageDraw.Draw(panel)
        place = _Place(centre[[right, up]], reach, right, up)
        circle = place(centre) + np.array([[-1.0], [1.0]]) * FINE * PANEL / 2 * box.scale / reach
        draw.ellipse([*map(float, circle.reshape(-1))], outline=PALE, width=FINE)
        colors = np.rint(127.5 * (points.normal[order] + 1.0)).astype(np.uint8)
        for (x, y), color in zip(place(points.position[order]), colors, strict=True):
            draw.rectangle([x - 1, y - 1, x + 1, y + 1], fill=tuple(map(int, color)))
        for view, pyramid in zip(views, pyramids, strict=True):
            eye, *corners = [tuple(map(float, corner)) for corner in place(pyramid)]
            color = TEST if view.name in test else TRAIN
            draw.line([*corners, corners[0]], fill=color, width=FINE)
            for corner in corners:
                draw.line([eye, corner], fill=color, width=FINE)
        left = MARGIN + i * (PANEL + MARGIN)
        sheet.paste(panel.resize((PANEL, PANEL), Image.Resampling.LANCZOS), (left, MARGIN + TITLE))
        _write(ImageDraw.Draw(sheet), (left, MARGIN // 2), title, TITLE)
    _write(ImageDraw.Draw(sheet), (2 * PANEL - 380, MARGIN // 2 + 6), "cameras to train on", NOTE, TRAIN)
    _write(ImageDraw.Draw(sheet), (2 * PANEL - 210, MARGIN // 2 + 6), "to test on", NOTE, TEST)
    _write(ImageDraw.Draw(sheet), (2 * PANEL - 110, MARGIN // 2 + 6), "points by their normals", NOTE, INK)
    return np.asarray(sheet)


def draw_fit(placed: Sequence[Placement], width: int) -> UInt8[np.ndarray, "H W 3"]:
    """A bar per image: its reprojection error in pixels; a full red bar where it has no pose."""
    sheet = Image.new("RGB", (width, FIT_HEIGHT + AXIS + MARGIN), PAPER)
    draw = ImageDraw.Draw(sheet)
    _write(draw, (MARGIN, 0), "reprojection error of each image, pixels", NOTE)
    errors = [p.error for p in placed if p.error is not None]
    top = max(TICK, TICK * np.ceil(max(errors, default=TICK) / TICK))
    base, height = FIT_HEIGHT + 24, FIT_HEIGHT - 10
    for value in np.arange(0.0, top + TICK / 2, TICK):
        y = base - height * value / top
        draw.line([(2 * MARGIN, y), (width - MARGIN, y)], fill=PALE)
        _write(draw, (MARGIN, int(y) - 9), f"{value:.1f}", NOTE)
    step = (width - 3 * MARGIN) / len(placed)
    labelled = max(1, -(-34 // max(int(step), 1)))
    for i, placement in enumerate(placed):
        left = 2 * MARGIN + i * step
        share, color = (1.0, BAD) if placement.error is None else (placement.error / top, TRAIN)
        draw.rectangle([left + 0.15 * step, base - height * share, left + 0.85 * step, base], fill=color)
        if i % labelled == 0:
            _write(draw, (int(left), base + 6), placement.name[-8:], 11)
    return np.asarray(sheet)


class _Place:
    """World positions as pixels of a panel, along two of the world's axes."""

    def __init__(self, centre: Float64[np.ndarray, " 2"], reach: float, right: int, up: int) -> None:
        self._axes, self._centre, self._scale = [right, up], centre, FINE * PANEL / 2 / reach

    def __call__(self, points: Float64[np.ndarray, "*N 3"]) -> Float64[np.ndarray, "*N 2"]:
        plane = (points[..., self._axes] - self._centre) * self._scale * np.array([1.0, -1.0])
        return plane + FINE * PANEL / 2


def _pyramid(camera: Camera, scale: float) -> Float64[np.ndarray, "5 3"]:
    """The eye and the corners of the image, in the world."""
    corners = np.array(
        [[0, 0], [camera.width, 0], [camera.width, camera.height], [0, camera.height]], dtype=np.float64
    )
    rays = np.pad(
        (corners - camera.intrinsics[2:]) / camera.intrinsics[:2], ((0, 0), (0, 1)), constant_values=1.0
    )
    rays *= FRUSTUM * scale / np.abs(rays[:, :2]).max()
    return np.concatenate([np.zeros((1, 3)), rays]) @ camera.c2w[:, :3].T + camera.c2w[:, 3]


def _write(
    draw: ImageDraw.ImageDraw,
    corner: tuple[int, int],
    text: str,
    size: int,
    color: tuple[int, int, int] = INK,
) -> None:
    draw.text(corner, text, font=ImageFont.load_default(size), fill=color)
