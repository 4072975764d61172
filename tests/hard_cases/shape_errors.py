"""Errors of a recovered shape: over all test rays, and at the rays that meet the hard part of the shape.

A part is a small share of the rays. Medians and the outline do not change if it is absent, so it has measures
of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from tests.hard_cases.known_shapes import SHAPES, Array, Distance, Seen, meet, photograph

Look = Callable[[Seen], Seen]
"""Rays to what is seen along them; the other attributes of the argument are ignored."""

PART_RAYS, AT_ONCE = 300, 20_000
"""Test rays that meet a part, and rays that are drawn at once to find them."""

PARTS: Mapping[str, Callable[[Seen], Array]] = {
    # the edge of the plate
    "thin plate": lambda seen: np.abs(seen.normal[:, 2]) < 0.5,
    "wire": lambda seen: seen.hit,
    # the walls of the gap
    "crevice": lambda seen: np.abs(seen.position[:, 0]) < 0.06,
    # the inside of the bowl
    "concave bowl": lambda seen: np.linalg.norm(seen.position, axis=-1) < 0.55,
    # the antenna without the ball
    "ball with an antenna": lambda seen: np.linalg.norm(seen.position, axis=-1) > 0.42,
}
"""Which hits (N,) lie on the hard part of a shape."""


@dataclass(frozen=True)
class Errors:
    """Errors at rays that were not trained on.

    Attributes:
        outline: share of the rays that meet the true or the found shape but not both.
        normal: median angle between found and true normals, degrees, where both have a surface.
        position: median distance between found and true hits, scene units, there.
        color: mean absolute error of the radiance of all rays.
        missed: share of the rays that meet the part of `PARTS` and not the found shape; 0 without a part.
        detail: median distance between found and true hits, scene units, of the other rays that meet the
            part; infinite if all are missed, 0 without a part.
    """

    outline: float
    normal: float
    position: float
    color: float
    missed: float = 0.0
    detail: float = 0.0


def rays_on_part(name: str, seed: int = 3, views: int = 40) -> Seen | None:
    """`PART_RAYS` rays that meet the hard part of a shape, or None if it has none."""
    if name not in PARTS:
        return None
    found: list[Seen] = []
    while sum(len(seen.hit) for seen in found) < PART_RAYS:
        seen = photograph(SHAPES[name], AT_ONCE, views, seed + len(found))
        found.append(chosen(seen, seen.hit & PARTS[name](seen)))
    return Seen(*(np.concatenate([getattr(s, f) for s in found])[:PART_RAYS] for f in Seen.__annotations__))


def chosen(seen: Seen, rows: Array) -> Seen:
    return Seen(*(getattr(seen, name)[rows] for name in Seen.__annotations__))


def look_at(shape: Distance) -> Look:
    """The look of an exact shape."""
    return lambda rays: meet(shape, rays.origins, rays.directions)


def compare(look: Look, truth: Seen, part: Seen | None = None) -> Errors:
    """Errors of a look at the rays of `truth`, and at the rays of `part`."""
    found = look(truth)
    both = truth.hit & found.hit
    cosine = (found.normal[both] * truth.normal[both]).sum(-1).clip(-1, 1)
    missed, detail = (0.0, 0.0) if part is None else at_part(look(part), part)
    return Errors(
        outline=float(1 - both.sum() / (truth.hit | found.hit).sum()),
        normal=float(np.degrees(np.median(np.arccos(cosine)))),
        position=float(np.median(apart(found, truth)[both])),
        color=float(np.abs(found.color - truth.color).mean()),
        missed=missed,
        detail=detail,
    )


def at_part(found: Seen, part: Seen) -> tuple[float, float]:
    """Share of rays that are missed, and the median distance of the others."""
    if not found.hit.any():
        return 1.0, float("inf")
    return float(1 - found.hit.mean()), float(np.median(apart(found, part)[found.hit]))


def apart(found: Seen, truth: Seen) -> Array:
    """Distances (N,) between hits, scene units."""
    return np.linalg.norm(found.position - truth.position, axis=-1)
