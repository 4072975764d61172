"""Text in the SVG charts of reports and tradeoffs."""

from __future__ import annotations

from neilfpp_method.report.markup import Html, element

__all__ = ["svg_text"]

FONT_SIZE = 12
"""Size of labels, pixels."""


def svg_text(x: float, y: float, text: str, anchor: str, color: str = "currentColor") -> Html:
    """Build a label.

    Args:
        x: horizontal position of the anchor, pixels.
        y: baseline, pixels downwards.
        text: the label.
        anchor: part of the text that is at `x`: "start", "middle" or "end".
        color: colour; by default that of the surrounding page.
    """
    place = {"x": f"{x:.1f}", "y": f"{y:.1f}", "text_anchor": anchor}
    return element("text", text, **place, fill=color, font_size=FONT_SIZE)
