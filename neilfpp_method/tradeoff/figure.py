"""Draw the frontier as SVG: a panel for each metric, which shows accuracy over time with labelled points."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence

from neilfpp_method.budget.durations import format_duration
from neilfpp_method.report.markup import Html, element
from neilfpp_method.report.svg import svg_text
from neilfpp_method.tradeoff.frontier import FIGURES, BudgetResult

__all__ = ["draw_frontier"]

COLUMNS = 3
"""Number of panels side by side."""
WIDTH, HEIGHT, HEAD = 330.0, 230.0, 44.0
"""Width and height of a panel, and height of the heading, in pixels."""
LEFT, RIGHT, TOP, BOTTOM = 48.0, 40.0, 34.0, 38.0
"""Margins of a panel around its plot, in pixels."""
INK, PALE, LINE, GRAY = "#1c1e22", "#5c626b", "#4477aa", "#aaaaaa"
"""Colours of text, of secondary text, of the curve, and of the labels of dominated points."""


def draw_frontier(title: str, points: Sequence[BudgetResult]) -> str:
    """Draw the frontier.

    The time axis is logarithmic. Error bars are one standard deviation over the seeds to either side.
    Dominated points are hollow.

    Returns:
        The SVG document.
    """
    names = [name for name in FIGURES if points and name in points[0].figures]
    rows = max(1, math.ceil(len(names) / COLUMNS))
    panels = [
        element(
            "g",
            *_panel(name, points),
            transform=f"translate({number % COLUMNS * WIDTH} {HEAD + number // COLUMNS * HEIGHT})",
        )
        for number, name in enumerate(names)
    ]
    size = {"width": COLUMNS * WIDTH, "height": HEAD + rows * HEIGHT}
    paper = element("rect", **size, fill="#ffffff")
    heading = element("text", title, x=LEFT, y=28, font_size=18, fill=INK)
    frame = {"xmlns": "http://www.w3.org/2000/svg", "font_family": "sans-serif"}
    return element("svg", paper, heading, *panels, **frame, **size) + "\n"


def _panel(name: str, points: Sequence[BudgetResult]) -> list[Html]:
    figure = FIGURES[name]
    ends = [
        point.figures[name] + sign * point.deviations.get(name, 0.0) for point in points for sign in (-1, 1)
    ]
    margin = 0.1 * max(max(ends) - min(ends), 0.1)
    low, high = min(ends) - margin, max(ends) + margin
    times = [math.log(point.seconds) for point in points]
    first, span = min(times), max(max(times) - min(times), 1e-6)

    def place(seconds: float, value: float) -> tuple[float, float]:
        across = (math.log(seconds) - first) / span if len(points) > 1 else 0.5
        up = (value - low) / (high - low)
        return LEFT + across * (WIDTH - LEFT - RIGHT), TOP + (1 - up) * (HEIGHT - TOP - BOTTOM)

    better = "higher" if figure.higher_is_better else "lower"
    drawn = [svg_text(LEFT, 18.0, f"{figure.title}, {figure.unit} ({better} is better)", "start", INK)]
    for value in (min(ends), max(ends)):
        height = place(points[0].seconds, value)[1]
        drawn.append(svg_text(LEFT - 6, height + 4, f"{value:.1f}", "end", PALE))
    caption = "time of the runs (logarithmic)"
    drawn.append(svg_text((LEFT + WIDTH - RIGHT) / 2, HEIGHT - 8, caption, "middle", PALE))
    line = [place(point.seconds, point.figures[name]) for point in points]
    path = " ".join(f"{x:.1f},{y:.1f}" for x, y in line)
    drawn.append(element("polyline", points=path, fill="none", stroke=LINE, stroke_width=2))
    return [*drawn, *(part for point in points for part in _marker(point, name, place))]


def _marker(
    point: BudgetResult, name: str, place: Callable[[float, float], tuple[float, float]]
) -> Iterator[Html]:
    """A point with its error bar and label; `place` converts seconds and a value to pixels."""
    value, deviation = point.figures[name], point.deviations.get(name)
    x, y = place(point.seconds, value)
    if deviation is not None:
        ends = (place(point.seconds, value + sign * deviation)[1] for sign in (-1, 1))
        bottom, top = (f"{end:.1f}" for end in ends)
        bar = {"x1": f"{x:.1f}", "x2": f"{x:.1f}", "y1": bottom, "y2": top}
        yield element("line", **bar, stroke=LINE)
    fill = "#ffffff" if point.dominated else LINE
    yield element("circle", cx=f"{x:.1f}", cy=f"{y:.1f}", r=4, fill=fill, stroke=LINE)
    label = f"{format_duration(point.budget)}: {value:.2f}"
    yield svg_text(x, y - 9, label, "middle", GRAY if point.dominated else INK)
