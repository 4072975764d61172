"""User-defined changes of the material before relighting, such as `roughness=0.2`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from neilfpp_method.data.views import Normalization
from neilfpp_method.errors import UserError
from neilfpp_method.structures import Material

__all__ = ["Box", "Edit", "Limit", "Materials", "parse_edits", "scene_box", "with_edits"]

Materials = Callable[[Float[Tensor, "N 3"]], Material]
"""The material at points of the scene frame."""
Limit = Callable[[Float[Tensor, "N 3"]], Bool[Tensor, "N 1"]]
"""Whether points of the surface are inside of the region that edits apply to."""

CHANNELS = {"base_color": 3, "roughness": 1, "metallic": 1}
"""Names of the material's parameters, and their numbers of channels."""


@dataclass(frozen=True)
class Edit:
    """A parameter of the material and its new value: one number, or one per channel."""

    name: str
    value: tuple[float, ...]


@dataclass(frozen=True)
class Box:
    """An axis-aligned box in the scene frame."""

    low: Float[Tensor, " 3"]
    high: Float[Tensor, " 3"]

    def contains(self, x: Float[Tensor, "N 3"]) -> Bool[Tensor, "N 1"]:
        """Whether points lie in the box."""
        return ((x >= self.low.to(x)) & (x <= self.high.to(x))).all(-1, keepdim=True)

    def may_meet(self, triangles: Float[Tensor, "F 3 3"]) -> bool:
        """Whether the bounding box of any triangle meets the box."""
        low, high = triangles.amin(1), triangles.amax(1)
        return bool(((high >= self.low.to(low)) & (low <= self.high.to(low))).all(-1).any())


def parse_edits(texts: Sequence[str]) -> list[Edit]:
    """Parse edits of the form name=value, with a number in [0, 1], or r,g,b for a linear colour.

    Raises:
        UserError: there is no such parameter, or the value is invalid.
    """
    return [_parse(text) for text in texts]


def scene_box(corners: Sequence[float], normalization: Normalization) -> Box:
    """Build a box from two opposite corners x y z x y z in the world frame.

    Raises:
        UserError: the box is empty, or a coordinate is not finite.
    """
    ends = torch.tensor(corners, dtype=torch.float64).view(2, 3)
    low, high = ends.amin(0), ends.amax(0)
    if not ends.isfinite().all() or (low == high).any():
        raise UserError(
            "--box has no inside", "give two opposite corners, x y z x y z, in the world frame of the capture"
        )
    return Box(normalization.to_scene(low).float(), normalization.to_scene(high).float())


def with_edits(materials: Materials, edits: Sequence[Edit], limits: Sequence[Limit] = ()) -> Materials:
    """Apply edits at the points inside of all limits; a later edit of a parameter replaces an earlier one."""
    if not edits:
        return materials

    def edited(x: Float[Tensor, "N 3"]) -> Material:
        material = materials(x)
        within = torch.ones_like(x[:, :1], dtype=torch.bool)
        for limit in limits:
            within &= limit(x)
        values = {field.name: getattr(material, field.name) for field in fields(material)}
        for edit in edits:
            old = values[edit.name]
            values[edit.name] = torch.where(within, old.new_tensor(edit.value).expand_as(old), old)
        return replace(material, **values)

    return edited


def _parse(text: str) -> Edit:
    name, equals, numbers = text.partition("=")
    name = name.strip()
    if not equals or name not in CHANNELS:
        raise UserError(
            f"--set {text}: no such parameter", f"give NAME=NUMBER with one of {', '.join(CHANNELS)}"
        )
    try:
        value = tuple(float(number) for number in numbers.split(","))
    except ValueError:
        value = ()
    if len(value) not in {1, CHANNELS[name]} or not all(0 <= number <= 1 for number in value):
        three = " or three of them, separated by commas" if CHANNELS[name] == 3 else ""
        raise UserError(f"--set {text}: not a value of {name}", f"give a number in 0 … 1{three}")
    return Edit(name, value)
