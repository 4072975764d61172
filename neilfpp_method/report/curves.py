"""What time bought: held-back quality over the seconds of a run, and what the seconds went to, as inline
SVG.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from neilfpp_method.report.markup import Html, element, joined
from neilfpp_method.timing.ledger import WORK
from neilfpp_method.train.quality import Look

__all__ = ["quality_curve", "work_bars"]

WIDTH, HEIGHT = 640.0, 260.0
LEFT, RIGHT, TOP, BOTTOM = 46.0, 96.0, 14.0, 40.0
BAR, GAP = 22.0, 14.0
LABEL_HEIGHT = 14.0
"""Vertical distance of labels that would overlap."""
TICKS = 5
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
"""One for each kind of work, in the order of `WORK`; told apart by most people with a colour vision of their
own, and named by the legend.
"""


def quality_curve(looks: Sequence[Look]) -> Html | None:
    """PSNR of R and of the rendering equation at held-back pixels over the seconds of the run; none: there
    was no look.
    """
    if not looks:
        return None
    radiance = [(look.seconds, look.radiance) for look in looks]
    physical = [(look.seconds, look.physical) for look in looks if look.physical is not None]
    values = [value for _, value in (*radiance, *physical)]
    x_ticks, y_ticks = _ticks(0.0, looks[-1].seconds), _ticks(min(values), max(values))
    right, low, high = max(x_ticks[-1], looks[-1].seconds), y_ticks[0], y_ticks[-1]

    def place(seconds: float, value: float) -> tuple[float, float]:
        across, up = seconds / max(right, 1e-9), (value - low) / (high - low)
        return LEFT + across * (WIDTH - LEFT - RIGHT), TOP + (1 - up) * (HEIGHT - TOP - BOTTOM)

    grid = [_text(place(x, low)[0], HEIGHT - BOTTOM + 18, f"{x:g}", "middle") for x in x_ticks]
    for y in y_ticks:
        height = place(0.0, y)[1]
        grid.append(_line(LEFT, height, WIDTH - RIGHT, height))
        grid.append(_text(LEFT - 6, height + 4, f"{y:g}", "end"))
    lines, labels = [], []
    for name, points, color in (("R", radiance, COLORS[0]), ("PBR", physical, COLORS[3])):
        if points:
            shown = [place(*point) for point in points]
            lines.append(_curve(shown, color))
            labels.append((shown[-1], f"{name} {points[-1][1]:.1f} dB"))
    previous = -math.inf
    for (x, y), text in sorted(labels, key=lambda label: label[0][1]):
        previous = max(y + 4, previous + LABEL_HEIGHT)
        lines.append(_text(x + 8, previous, text, "start"))
    caption = _text((LEFT + WIDTH - RIGHT) / 2, HEIGHT - 4, "seconds of the run", "middle")
    return _svg(HEIGHT, "PSNR of held-back pixels over seconds", *grid, *lines, caption)


def work_bars(work: Mapping[str, Mapping[str, float]], titles: Mapping[str, str]) -> Html | None:
    """A bar for each stage, as long as it took, divided by kind of work; none: nothing was recorded."""
    sums = {stage: sum(parts.values()) for stage, parts in work.items()}
    longest = max(sums.values(), default=0.0)
    if longest <= 0.0:
        return None
    left, bars, seen = 110.0, [], set()
    for number, (stage, parts) in enumerate(work.items()):
        top, x = TOP + number * (BAR + GAP), left
        bars.append(_text(left - 8, top + 15, titles.get(stage, stage), "end"))
        for kind, color in zip(WORK, COLORS, strict=True):
            width = (WIDTH - left - 60) * parts.get(kind, 0.0) / longest
            if width > 0:
                told = element("title", f"{kind.replace('_', ' ')}: {parts[kind]:.1f} s")
                box = {"x": f"{x:.1f}", "y": top, "width": f"{width:.1f}", "height": BAR, "fill": color}
                bars.append(element("rect", told, **box))
                seen.add(kind)
            x += width
        bars.append(_text(x + 6, top + 15, f"{sums[stage]:.0f} s", "start"))
    height = TOP + len(work) * (BAR + GAP)
    legend = (
        element("span", element("span", "■ ", style=f"color: {color}"), f"{kind.replace('_', ' ')}  ")
        for kind, color in zip(WORK, COLORS, strict=True)
        if kind in seen
    )
    return joined(
        _svg(height, "Seconds of each stage by kind of work", *bars), element("p", *legend, class_="pale")
    )


def _ticks(low: float, high: float) -> list[float]:
    """Round numbers from at most the lowest value to at least the highest, some five of them.

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


def _text(x: float, y: float, text: str, anchor: str) -> Html:
    place = {"x": f"{x:.1f}", "y": f"{y:.1f}", "text_anchor": anchor}
    return element("text", text, **place, fill="currentColor", font_size=12)


def _svg(height: float, label: str, *children: Html) -> Html:
    size = {"viewBox": f"0 0 {WIDTH} {height}", "width": WIDTH, "style": "max-width: 100%; height: auto"}
    return element("svg", *children, **size, role="img", aria_label=label)
