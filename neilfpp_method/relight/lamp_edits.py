"""User-defined changes of lamps by index: `0=1.2,0,0.8` moves a lamp, `1=off` removes it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch

from neilfpp_method.data.views import Normalization
from neilfpp_method.errors import UserError
from neilfpp_method.relight.lamplight import Lamplight

__all__ = ["LampEdit", "edited_lamps", "parse_lamp_edits"]

OFF = "off"


@dataclass(frozen=True)
class LampEdit:
    """The index of a lamp, and its new position in the world frame; None removes the lamp."""

    number: int
    position: tuple[float, float, float] | None


def parse_lamp_edits(texts: Sequence[str]) -> list[LampEdit]:
    """Parse edits of the form INDEX=x,y,z or INDEX=off; indices start at 0.

    Raises:
        UserError: an edit has another form, or a lamp is given twice.

    Example:
        >>> parse_lamp_edits(["0=1,0.5,2", "2=off"])
        [LampEdit(number=0, position=(1.0, 0.5, 2.0)), LampEdit(number=2, position=None)]
    """
    edits = [_parse(text) for text in texts]
    numbers = [edit.number for edit in edits]
    for number in numbers:
        if numbers.count(number) > 1:
            raise UserError(f"--lamp {number} is given twice", "give each lamp only once")
    return edits


def edited_lamps(
    lamps: Lamplight | None, edits: Sequence[LampEdit], normalization: Normalization
) -> Lamplight | None:
    """Move or remove lamps. The axis of a panel does not change.

    Args:
        lamps: the lamps of the run, or None.
        edits: the changes.
        normalization: transformation from the world frame to the scene frame.

    Returns:
        The remaining lamps, or None if there are none.

    Raises:
        UserError: the run has no lamp of an index.
    """
    count = 0 if lamps is None else len(lamps.position)
    for edit in edits:
        if edit.number >= count:
            has = f"{count}, numbered from 0" if count else "none"
            raise UserError(
                f"--lamp {edit.number}: the run has no such lamp; it has {has}",
                "`neilfpp export RUN --what light` lists them in lamps.json",
            )
    if lamps is None or not edits:
        return lamps
    position = lamps.position.clone()
    remaining = torch.ones(count, dtype=torch.bool, device=position.device)
    for edit in edits:
        if edit.position is None:
            remaining[edit.number] = False
        else:
            world_position = torch.tensor(edit.position, dtype=torch.float64)
            position[edit.number] = normalization.to_scene(world_position).to(position)
    if not remaining.any():
        return None
    return Lamplight(position[remaining], lamps.axis[remaining], lamps.radiance[remaining], lamps.radius)


def _parse(text: str) -> LampEdit:
    number, equals, value = (part.strip() for part in text.partition("="))
    try:
        if not (equals and number.isdecimal()):
            raise ValueError
        if value == OFF:
            return LampEdit(int(number), None)
        x, y, z = (float(coordinate) for coordinate in value.split(","))
        if not all(math.isfinite(coordinate) for coordinate in (x, y, z)):
            raise ValueError
    except ValueError:
        remedy = "give INDEX=x,y,z (world frame) or INDEX=off, for example --lamp 0=1,0.5,2 --lamp 1=off"
        raise UserError(f"--lamp {text}: not an edit of a lamp", remedy) from None
    return LampEdit(int(number), (x, y, z))
