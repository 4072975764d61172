"""The HTML of the report: one file with everything in it, readable in light and in dark."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape

import cv2
import numpy as np
from jaxtyping import UInt8

from neilfpp_method.evaluate.glossary import explain

__all__ = ["Figure", "report_page"]

STAGE_TITLES = {"sdf_init": "SDF init", "material_init": "Material init", "joint": "Joint"}

READING = {
    "Truth, estimate, error.": (
        "Dark errors are small; the scale under a row's title says what its brightest colour stands for. Columns "
        "of truth are missing where the capture has none."
    ),
    "Base colour and light share a factor.": (
        "Twice the light on half the base colour gives the same images, in each channel. Unless the scene holds "
        "something of known colour, that factor is free. So base colour is shown as estimated and with the best "
        "factor per channel, and the light with the inverse of it. Neither alone tells enough."
    ),
    "Roughness and metallic need highlights.": "Where a surface shows none, the priors decide: rough, and no metal.",
    "Light is known where it matters.": (
        "It is estimated above surfaces that the images show. Where the surface is rough, only its broad shape "
        "leaves a trace in the images."
    ),
    "Figures.": (
        "They are means over the test views, of the pixels that show the object. PSNR grows by 6 dB when the error "
        "halves. The whole frame counts the background as free of error, as some published tables do, and is higher "
        "by its share. What needs no method is a constant for roughness and metallic, and the mean image for base "
        "colour."
    ),
    "Display values clip.": "8-bit captures lose what is brighter than white; light and metallic then come out low.",
}


@dataclass(frozen=True)
class Figure:
    """A picture with its title and caption."""

    title: str
    caption: str
    pixels: UInt8[np.ndarray, "H W 3"]


def report_page(
    title: str,
    subtitle: str,
    figures: Sequence[Figure],
    metrics: Mapping[str, float],
    timing: Mapping[str, float],
    facts: Mapping[str, str],
) -> str:
    """The whole page.

    Args:
        title: of the run.
        subtitle: one line below it.
        figures: pictures, in order.
        metrics: figures by name; `baseline_x` stands beside `x`.
        timing: seconds of each stage.
        facts: what made the run.
    """
    body = "\n".join(
        [
            f"<header><h1>{escape(title)}</h1><p>{escape(subtitle)}</p></header>",
            *map(_figure, figures),
            _section("Figures", _metrics_table(metrics)),
            _section("Time", _timing_table(timing)),
            _section("How to read this", _reading()),
            _section("What made it", _facts_table(facts)),
        ]
    )
    return PAGE.format(title=escape(title), style=STYLE, body=body)


def _section(title: str, content: str) -> str:
    return f"<section><h2>{escape(title)}</h2>{content}</section>"


def _figure(figure: Figure) -> str:
    encoded = cv2.imencode(".png", np.ascontiguousarray(figure.pixels[..., ::-1]))[1].tobytes()
    source = "data:image/png;base64," + base64.b64encode(encoded).decode("ascii")
    picture = f'<img alt="{escape(figure.title)}" src="{source}">'
    return _section(figure.title, f"<figure>{picture}<figcaption>{escape(figure.caption)}</figcaption></figure>")


def _metrics_table(metrics: Mapping[str, float]) -> str:
    """A row per figure; `x_frame` and `baseline_x` stand in the row of `x`."""
    if not metrics:
        return "<p>Nothing was measured: no view is held out, or there is no truth.</p>"
    beside = {name: (f"{name}_frame", f"baseline_{name}") for name in metrics}
    companions = {companion for pair in beside.values() for companion in pair}
    rows = []
    for name in metrics:
        if name in companions:
            continue
        entry = explain(name)
        value, frame, baseline = (entry.format(metrics[key]) if key in metrics else "–" for key in (name, *beside[name]))
        arrow = {"higher": "↑", "lower": "↓"}[entry.better]
        rows.append(
            f"<tr><th>{escape(entry.title)}<code>{escape(name)}</code></th>"
            f'<td class="number"><b>{value}</b> <i title="{entry.better} is better">{arrow}</i></td>'
            f'<td class="number">{frame}</td><td class="number">{baseline}</td><td>{escape(entry.meaning)}</td></tr>'
        )
    names = ("figure", "this run", "whole frame", "without a method", "what it says")
    head = "".join(f"<th>{name}</th>" for name in names)
    return f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>{"".join(rows)}</tbody></table></div>'


def _timing_table(timing: Mapping[str, float]) -> str:
    if not timing:
        return "<p>No stage has been timed.</p>"
    total = sum(timing.values())
    rows = [
        f"<tr><th>{escape(STAGE_TITLES.get(stage, stage))}</th><td class='number'>{_duration(seconds)}</td>"
        f'<td class="bar"><i style="width:{100.0 * seconds / max(total, 1e-9):.1f}%"></i></td></tr>'
        for stage, seconds in timing.items()
    ]
    rows.append(f"<tr><th>Together</th><td class='number'><b>{_duration(total)}</b></td><td></td></tr>")
    return f"<table>{''.join(rows)}</table>"


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes:02d} min"
    return f"{minutes} min {rest:02d} s" if minutes else f"{seconds:.1f} s"


def _reading() -> str:
    lines = (f"<li><b>{escape(head)}</b> {escape(text)}</li>" for head, text in READING.items())
    return f"<ul>{''.join(lines)}</ul>"


def _facts_table(facts: Mapping[str, str]) -> str:
    rows = (f"<tr><th>{escape(name)}</th><td>{escape(text)}</td></tr>" for name, text in facts.items())
    return f'<table class="facts">{"".join(rows)}</table>'


PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>{style}</style>
</head>
<body>
{body}
</body>
</html>
"""

STYLE = """
:root { color-scheme: light dark; --paper: #fafaf8; --card: #fff; --ink: #1c1e22; --pale: #6b7079; --line: #e3e4e6;
  --accent: #3b6ea8; }
@media (prefers-color-scheme: dark) {
  :root { --paper: #16181c; --card: #1f2227; --ink: #e8e9eb; --pale: #9aa0a9; --line: #343840; --accent: #7fb0e6; } }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 1280px; padding: 3rem 1.5rem; background: var(--paper); color: var(--ink);
  font: 16px/1.55 system-ui, -apple-system, "Segoe UI", sans-serif; }
h1 { margin: 0; font-size: 2rem; font-weight: 650; letter-spacing: -0.02em; }
h2 { margin: 0 0 1rem; font-size: 1.15rem; font-weight: 600; }
header p, figcaption { margin: 0.4rem 0 0; color: var(--pale); }
section { margin-top: 2rem; padding: 1.5rem; background: var(--card); border: 1px solid var(--line);
  border-radius: 12px; }
figure { margin: 0; }
img { display: block; width: 100%; height: auto; border-radius: 8px; background: #fafaf8; }
figcaption { max-width: 50rem; font-size: 0.9rem; }
.wide { overflow-x: auto; }
table { width: 100%; border-collapse: collapse; font-size: 0.93rem; }
th, td { padding: 0.55rem 0.9rem 0.55rem 0; border-bottom: 1px solid var(--line); text-align: left;
  vertical-align: top; }
tr:last-child > * { border-bottom: 0; }
thead th { color: var(--pale); font-size: 0.85rem; font-weight: 500; white-space: nowrap; }
tbody th { font-weight: 500; }
code { display: block; color: var(--pale); font: 0.78rem ui-monospace, Menlo, Consolas, monospace; }
.number { white-space: nowrap; font-variant-numeric: tabular-nums; }
.number i { color: var(--pale); font-style: normal; }
.bar { width: 60%; }
.bar i { display: block; height: 0.7rem; margin-top: 0.4rem; border-radius: 4px; background: var(--accent); }
.facts th { width: 11rem; }
.facts td { white-space: pre-line; overflow-wrap: anywhere; }
ul { margin: 0; padding-left: 1.2rem; max-width: 50rem; }
li { margin: 0.5rem 0; }
"""
