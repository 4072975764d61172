"""Lamps that a person moves or leaves out: `0=1.2,0,0.8` or `1=off`, by their numbers in `lamps.json`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch

from neilfpp_method.data.views import Normalisation
from neilfpp_method.errors import UserError
from neilfpp_method.relight.lamplight import Lamplight

__all__ = ["LampEdit", "edited_lamps", "parse_lamp_edits"]

OFF = "off"


@dataclass(frozen=True)
class LampEdit:
    """A lamp by its number, and its new place in the capture's world; none: it is left out."""

    number: int
    position: tuple[float, float, float] | None


def parse_lamp_edits(texts: Sequence[str]) -> list[LampEdit]:
    """Edits as a person writes them: a number from 0 on, `=`, and a place x,y,z or `off`.

    Raises:
        UserError: not of that form, or one lamp twice.

    Example:
        >>> parse_lamp_edits(["0=1,0.5,2", "2=off"])
        [LampEdit(number=0, position=(1.0, 0.5, 2.0)), LampEdit(number=2, position=None)]
    """
    edits = [_parse(text) for text in texts]
    numbers = [edit.number for edit in edits]
    for number in numbers:
        if numbers.count(number) > 1:
            raise UserError(f"--lamp {number} is given twice", "give each lamp one place")
    return edits


def edited_lamps(
    lamps: Lamplight | None, edits: Sequence[LampEdit], normalisation: Normalisation
) -> Lamplight | None:
    """The lamps of a run with some moved, and without those that are left out; none where none is left.

    A panel keeps the way it faces.

    Raises:
        UserError: the run has no lamp of a number.
    """
    count = 0 if lamps is None else len(lamps.position)
    for edit in edits:
        if edit.number >= count:
            has = f"{count}, numbered from 0" if count else "none"
            raise UserError(
                f"--lamp {edit.number}: the run has no such lamp; it has {has}",
                "see lamps.json of `neilfpp export RUN --what light`",
            )
    if lamps is None or not edits:
        return lamps
    position, kept = lamps.position.clone(), torch.ones(count, dtype=torch.bool, device=lamps.position.device)
    for edit in edits:
        if edit.position is None:
            kept[edit.number] = False
        else:
            place = torch.tensor(edit.position, dtype=torch.float64)
            position[edit.number] = normalisation.to_scene(place).to(position)
    if not kept.any():
        return None
    return Lamplight(position[kept], lamps.axis[kept], lamps.radiance[kept], lamps.radius)


def _parse(text: str) -> LampEdit:
    number, equals, place = (part.strip() for part in text.partition("="))
    try:
        if not (equals and number.isdecimal()):
            raise ValueError
        if place == OFF:
            return LampEdit(int(number), None)
        x, y, z = (float(coordinate) for coordinate in place.split(","))
        if not all(math.isfinite(coordinate) for coordinate in (x, y, z)):
            raise ValueError
    except ValueError:
        remedy = "write its number, = and x,y,z in the capture's world, or off: --lamp 0=1,0.5,2 --lamp 1=off"
        raise UserError(f"--lamp {text}: not an edit of a lamp", remedy) from None
    return LampEdit(int(number), (x, y, z))
