"""A material that a person changes before it is relit: `roughness=0.2`, everywhere or within limits."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from neilfpp_method.data.views import Normalisation
from neilfpp_method.errors import UserError
from neilfpp_method.structures import Material

__all__ = ["Box", "Edit", "Limit", "Materials", "edited", "parse_edits", "scene_box"]

Materials = Callable[[Float[Tensor, "N 3"]], Material]
Limit = Callable[[Float[Tensor, "N 3"]], Bool[Tensor, "N 1"]]
"""At which points of the surface an edit counts."""

CHANNELS = {"base_color": 3, "roughness": 1, "metallic": 1}


@dataclass(frozen=True)
class Edit:
    """One parameter of the material, and what it becomes."""

    name: str
    value: tuple[float, ...]


@dataclass(frozen=True)
class Box:
    """A box along the axes of the scene frame."""

    low: Float[Tensor, " 3"]
    high: Float[Tensor, " 3"]

    def holds(self, x: Float[Tensor, "N 3"]) -> Bool[Tensor, "N 1"]:
        """Which points lie in it."""
        return ((x >= self.low.to(x)) & (x <= self.high.to(x))).all(-1, keepdim=True)


def parse_edits(texts: Sequence[str]) -> list[Edit]:
    """Edits as written: a name, `=`, and one number in [0, 1], or three with commas for a linear colour.

    Raises:
        UserError: no such parameter, or no such value.
    """
    return [_parse(text) for text in texts]


def scene_box(corners: Sequence[float], normalisation: Normalisation) -> Box:
    """A box from two opposite corners in the capture's world frame, x y z x y z.

    Raises:
        UserError: it has no inside.
    """
    ends = torch.tensor(corners, dtype=torch.float64).view(2, 3)
    low, high = ends.amin(0), ends.amax(0)
    if not ends.isfinite().all() or (low == high).any():
        raise UserError(
            "--box has no inside", "give two opposite corners, x y z x y z, in the capture's world frame"
        )
    return Box(normalisation.to_scene(low).float(), normalisation.to_scene(high).float())


def edited(materials: Materials, edits: Sequence[Edit], limits: Sequence[Limit] = ()) -> Materials:
    """The materials with edits, the last of each parameter counting; where every limit holds."""
    if not edits:
        return materials

    def changed(x: Float[Tensor, "N 3"]) -> Material:
        material = materials(x)
        within = torch.ones_like(x[:, :1], dtype=torch.bool)
        for limit in limits:
            within &= limit(x)
        values = {field.name: getattr(material, field.name) for field in fields(material)}
        for edit in edits:
            old = values[edit.name]
            values[edit.name] = torch.where(within, old.new_tensor(edit.value).expand_as(old), old)
        return replace(material, **values)

    return changed


def _parse(text: str) -> Edit:
    name, equals, numbers = text.partition("=")
    name = name.strip()
    if not equals or name not in CHANNELS:
        raise UserError(
            f"--set {text}: no such parameter", f"write one of {', '.join(CHANNELS)}, then = and a number"
        )
    try:
        value = tuple(float(number) for number in numbers.split(","))
    except ValueError:
        value = ()
    if len(value) not in {1, CHANNELS[name]} or not all(0 <= number <= 1 for number in value):
        many = " or three of them, by commas" if CHANNELS[name] == 3 else ""
        raise UserError(f"--set {text}: not a value of {name}", f"give a number in 0 … 1{many}")
    return Edit(name, value)
