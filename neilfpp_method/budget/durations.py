"""Parse and format durations such as `10m`."""

from __future__ import annotations

import re

from neilfpp_method.errors import UserError

__all__ = ["format_duration", "read_duration"]

UNITS = {"h": 3600.0, "m": 60.0, "s": 1.0}
"""Seconds per unit."""
MAX_HOURS = 24 * 30
"""Longest duration that is accepted, in hours: a month."""


def read_duration(text: str) -> float:
    """Parse a duration into seconds.

    Raises:
        UserError: if the text is not a duration, or if it is 0 or longer than `MAX_HOURS`.

    >>> read_duration("90s"), read_duration("10m"), read_duration("1h30m")
    (90.0, 600.0, 5400.0)
    """
    parts = re.fullmatch(r"(?:(\d+(?:\.\d+)?)h)?(?:(\d+(?:\.\d+)?)m)?(?:(\d+(?:\.\d+)?)s)?", text.strip())
    if parts is None or not any(parts.groups()):
        raise UserError(f"'{text}' is not a duration", "write it as 90s, 10m, 1h or 1h30m")
    seconds = sum(float(n or 0) * unit for n, unit in zip(parts.groups(), UNITS.values(), strict=True))
    if not 0 < seconds <= MAX_HOURS * 3600:
        raise UserError(f"'{text}' is out of range", f"give more than 0 and at most {MAX_HOURS}h")
    return seconds


def format_duration(seconds: float) -> str:
    """Format a duration as `read_duration` parses it, rounded to seconds, or to minutes from an hour on.

    >>> format_duration(59.6), format_duration(600), format_duration(754), format_duration(5400)
    ('1m', '10m', '12m34s', '1h30m')
    """
    whole = round(seconds)
    if whole >= 3600:
        minutes = round(seconds / 60)
        return f"{minutes // 60}h" + (f"{minutes % 60}m" if minutes % 60 else "")
    if whole >= 60:
        return f"{whole // 60}m" + (f"{whole % 60}s" if whole % 60 else "")
    return f"{whole}s"
