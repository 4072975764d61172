"""Colours and text of drawn pictures."""

from __future__ import annotations

from PIL import ImageDraw, ImageFont

__all__ = ["INK", "PALE_INK", "PAPER", "Color", "write"]

Color = tuple[int, int, int]
"""sRGB bytes."""
PAPER: Color = (250, 250, 248)
"""Background."""
INK: Color = (28, 30, 34)
"""Titles and text."""
PALE_INK: Color = (112, 116, 124)
"""Notes, lines and axes."""


def write(
    draw: ImageDraw.ImageDraw,
    corner: tuple[int | float, int | float],
    text: str,
    size: int,
    color: Color = INK,
) -> None:
    """Write one or several lines with their top left corner at a pixel; `size` in pixels."""
    draw.multiline_text(corner, text, font=ImageFont.load_default(size), fill=color, spacing=4)
