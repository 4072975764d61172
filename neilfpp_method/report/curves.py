"""Charts of training time as inline SVG: held-back quality over time, and the time of each kind of work."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from neilfpp_method.report.markup import Html, element, joined
from neilfpp_method.report.svg import svg_text
from neilfpp_method.timing.ledger import WORK
from neilfpp_method.train.quality import QualityCheck

__all__ = ["quality_curve", "work_bars"]

WIDTH, HEIGHT = 640.0, 260.0
"""Size of a chart, pixels. The height of `work_bars` depends on the number of stages."""
LEFT, RIGHT, TOP, BOTTOM = 46.0, 96.0, 14.0, 40.0
"""Margins around the plot, pixels, for the labels."""
BAR, GAP = 22.0, 14.0
"""Height of a bar and distance between bars, pixels."""
STAGE_WIDTH, SECONDS_WIDTH = 110.0, 60.0
"""Space for the name of a stage left of its bar, and for its seconds right of it, pixels."""
LABEL_HEIGHT = 14.0
"""Smallest vertical distance between two labels, pixels."""
TICKS = 5
"""Approximate number of intervals between axis labels."""
COLORS = (
    "#4477aa",
    "#228833",
    "#ccbb44",
    "#ee6677",
    "#aa3377",
    "#66ccee",
    "#bbbbbb",
    "#ee8866",
    "#44bb99",
    "#99ddff",
    "#777777",
)
"""Colours of the kinds of work, in the order of `WORK`, chosen so that readers with colour blindness can
distinguish most of them; the legend names them.
"""


def quality_curve(checks: Sequence[QualityCheck]) -> Html | None:
    """Draw the PSNR of R and of the rendering equation at held-back pixels over the seconds of the run.

    Returns None if there was no measurement during training.
    """
    if not checks:
        return None
    radiance = [(check.seconds, check.radiance) for check in checks]
    physical = [(check.seconds, check.physical) for check in checks if check.physical is not None]
    values = [value for _, value in (*radiance, *physical)]
    x_ticks, y_ticks = _ticks(0.0, checks[-1].seconds), _ticks(min(values), max(values))
    right, low, high = max(x_ticks[-1], checks[-1].seconds), y_ticks[0], y_ticks[-1]

    def to_pixels(seconds: float, value: float) -> tuple[float, float]:
        across, up = seconds / max(right, 1e-9), (value - low) / (high - low)
        return LEFT + across * (WIDTH - LEFT - RIGHT), TOP + (1 - up) * (HEIGHT - TOP - BOTTOM)

    grid = [svg_text(to_pixels(x, low)[0], HEIGHT - BOTTOM + 18, f"{x:g}", "middle") for x in x_ticks]
    for y in y_ticks:
        height = to_pixels(0.0, y)[1]
        grid.append(_line(LEFT, height, WIDTH - RIGHT, height))
        grid.append(svg_text(LEFT - 6, height + 4, f"{y:g}", "end"))
    lines, labels = [], []
    for name, points, color in (("R", radiance, COLORS[0]), ("PBR", physical, COLORS[3])):
        if points:
            pixels = [to_pixels(*point) for point in points]
            x, y = pixels[-1]
            lines.append(_curve(pixels, color))
            labels.append((x + 8, y + 4, f"{name} {points[-1][1]:.1f} dB"))
    previous = -math.inf
    for x, y, text in sorted(labels, key=lambda label: label[1]):
        previous = max(y, previous + LABEL_HEIGHT)
        lines.append(svg_text(x, previous, text, "start"))
    caption = svg_text((LEFT + WIDTH - RIGHT) / 2, HEIGHT - 4, "seconds of the run", "middle")
    return _svg(HEIGHT, "PSNR of held-back pixels over seconds", *grid, *lines, caption)


def work_bars(work: Mapping[str, Mapping[str, float]], titles: Mapping[str, str]) -> Html | None:
    """Draw a bar for each stage, divided by kind of work; its length is proportional to the stage's time.

    Args:
        work: seconds by stage and kind of work.
        titles: titles of the stages.

    Returns:
        The chart with its legend, or None if no time was recorded.
    """
    sums = {stage: sum(parts.values()) for stage, parts in work.items()}
    longest = max(sums.values(), default=0.0)
    if longest <= 0.0:
        return None
    bars, drawn = [], set()
    for number, (stage, parts) in enumerate(work.items()):
        top, x = TOP + number * (BAR + GAP), STAGE_WIDTH
        bars.append(svg_text(x - 8, top + 15, titles.get(stage, stage), "end"))
        for kind, color in zip(WORK, COLORS, strict=True):
            width = (WIDTH - STAGE_WIDTH - SECONDS_WIDTH) * parts.get(kind, 0.0) / longest
            if width > 0:
                tooltip = element("title", f"{kind.replace('_', ' ')}: {parts[kind]:.1f} s")
                box = {"x": f"{x:.1f}", "y": top, "width": f"{width:.1f}", "height": BAR, "fill": color}
                bars.append(element("rect", tooltip, **box))
                drawn.add(kind)
            x += width
        bars.append(svg_text(x + 6, top + 15, f"{sums[stage]:.0f} s", "start"))
    height = TOP + len(work) * (BAR + GAP)
    legend = (
        element("span", element("span", "■ ", style=f"color: {color}"), f"{kind.replace('_', ' ')}  ")
        for kind, color in zip(WORK, COLORS, strict=True)
        if kind in drawn
    )
    chart = _svg(height, "Seconds of each stage by kind of work", *bars)
    return joined(chart, element("p", *legend, class_="pale"))


def _ticks(low: float, high: float) -> list[float]:
    """About `TICKS` round numbers, from at most `low` to at least `high`.

    >>> _ticks(18.2, 26.9)
    [18.0, 20.0, 22.0, 24.0, 26.0, 28.0]
    """
    raw = max(high - low, 1e-3) / TICKS
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(s * power for s in (1, 2, 5, 10) if s * power >= raw)
    first = math.floor(low / step)
    return [round(n * step, 6) for n in range(first, max(math.ceil(high / step), first + 1) + 1)]


def _curve(points: Sequence[tuple[float, float]], color: str) -> Html:
    path = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    dots = (element("circle", cx=f"{x:.1f}", cy=f"{y:.1f}", r=3, fill=color) for x, y in points)
    return joined(element("polyline", points=path, fill="none", stroke=color, stroke_width=2), *dots)


def _line(x: float, y: float, to_x: float, to_y: float) -> Html:
    ends = {"x1": f"{x:.1f}", "y1": f"{y:.1f}", "x2": f"{to_x:.1f}", "y2": f"{to_y:.1f}"}
    return element("line", **ends, stroke="currentColor", stroke_opacity=0.15)


def _svg(height: float, label: str, *children: Html) -> Html:
    size = {"viewBox": f"0 0 {WIDTH} {height}", "width": WIDTH, "style": "max-width: 100%; height: auto"}
    return element("svg", *children, **size, role="img", aria_label=label)
