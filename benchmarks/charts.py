"""Line charts with logarithmic axes as arrays, drawn with Pillow in the style of the report's images."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from neilfpp_method.data.files.images import write_png
from neilfpp_method.drawing.ink import PALE_INK, PAPER, write

__all__ = ["Chart", "Line", "draw_charts"]

WIDTH, HEIGHT = 420, 300
LEFT, TOP, BOTTOM, GAP = 62, 34, 42, 18
HEAD, LEGEND = 58, 26
GRID = (222, 222, 218)
COLORS = (
    (28, 30, 34),
    (214, 102, 34),
    (36, 118, 178),
    (52, 148, 84),
    (150, 76, 160),
    (190, 158, 40),
    (120, 124, 132),
)


@dataclass(frozen=True)
class Line:
    """A series of points; all x and y are above 0."""

    x: Sequence[float]
    y: Sequence[float]


@dataclass(frozen=True)
class Chart:
    """One panel: lines by name. Lines with the same name have the same colour in all panels."""

    title: str
    lines: Mapping[str, Line]


def draw_charts(
    path: Path, title: str, x_name: str, y_name: str, charts: Sequence[Chart], columns: int
) -> None:
    """Write panels with common axes and one legend as a PNG, `columns` panels side by side."""
    names = list(dict.fromkeys(name for chart in charts for name in chart.lines))
    lines = [line for chart in charts for line in chart.lines.values()]
    axes = Axes(
        _range([x for line in lines for x in line.x]),
        _range([y for line in lines for y in line.y]),
        f"{y_name} over {x_name}",
    )
    colors = {name: COLORS[number % len(COLORS)] for number, name in enumerate(names)}
    rows = math.ceil(len(charts) / columns)
    width = columns * (LEFT + WIDTH + GAP) + GAP
    per_line = max(1, width // 250)
    head = HEAD + LEGEND * math.ceil(len(names) / per_line)
    sheet = Image.new("RGB", (width, head + rows * (TOP + HEIGHT + BOTTOM)), PAPER)
    draw = ImageDraw.Draw(sheet)
    write(draw, (GAP, 16), title, 22)
    for number, name in enumerate(names):
        x, y = GAP + number % per_line * 250, HEAD + number // per_line * LEGEND
        draw.line([(x, y + 9), (x + 26, y + 9)], fill=colors[name], width=3)
        write(draw, (x + 34, y), name, 15)
    for number, chart in enumerate(charts):
        corner = (
            number % columns * (LEFT + WIDTH + GAP) + LEFT,
            head + number // columns * (TOP + HEIGHT + BOTTOM) + TOP,
        )
        _panel(draw, corner, chart, axes, colors)
    write_png(path, np.asarray(sheet))


@dataclass(frozen=True)
class Axes:
    """Decimal logarithms of the smallest and largest x and y, and the caption."""

    x: tuple[float, float]
    y: tuple[float, float]
    caption: str

    def place(self, corner: tuple[int, int], x: float, y: float) -> tuple[float, float]:
        """Pixel of a point in the panel whose upper left corner is given."""
        across = (math.log10(x) - self.x[0]) / (self.x[1] - self.x[0])
        up = (math.log10(y) - self.y[0]) / (self.y[1] - self.y[0])
        return corner[0] + across * WIDTH, corner[1] + (1 - up) * HEIGHT


def _range(values: Sequence[float]) -> tuple[float, float]:
    low, high = math.log10(min(values)), math.log10(max(values))
    margin = 0.04 * max(high - low, 0.1)
    return low - margin, high + margin


def _panel(
    draw: ImageDraw.ImageDraw,
    corner: tuple[int, int],
    chart: Chart,
    axes: Axes,
    colors: Mapping[str, tuple[int, int, int]],
) -> None:
    left, top = corner
    write(draw, (left, top - 26), chart.title, 16)
    for tick in _ticks(*axes.x):
        x, _ = axes.place(corner, tick, 10 ** axes.y[0])
        draw.line([(x, top), (x, top + HEIGHT)], fill=GRID)
        write(draw, (x - 8, top + HEIGHT + 4), f"{tick:g}", 12, PALE_INK)
    for tick in _ticks(*axes.y):
        _, y = axes.place(corner, 10 ** axes.x[0], tick)
        draw.line([(left, y), (left + WIDTH, y)], fill=GRID)
        write(draw, (left - 44, y - 8), f"{tick:g}", 12, PALE_INK)
    write(draw, (left, top + HEIGHT + 20), axes.caption, 12, PALE_INK)
    for name, line in chart.lines.items():
        points = [axes.place(corner, x, y) for x, y in zip(line.x, line.y, strict=True)]
        draw.line(points, fill=colors[name], width=3, joint="curve")
        for x, y in points:
            draw.ellipse([(x - 3, y - 3), (x + 3, y + 3)], fill=colors[name])


def _ticks(low: float, high: float) -> list[float]:
    """1, 2 and 5 times the powers of ten in a logarithmic range; more ticks if the range is short."""
    steps = (1, 2, 5) if high - low > 0.7 else (1, 1.5, 2, 2.5, 3, 4, 5, 7)
    candidates = [
        step * 10.0**power for power in range(math.floor(low), math.ceil(high) + 1) for step in steps
    ]
    return [tick for tick in candidates if low <= math.log10(tick) <= high]
