"""Shapes that are hard to recover, as exact distances in float64 NumPy, and pixels that show them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

Array = np.ndarray
Distance = Callable[[Array], Array]

CAMERAS, INSIDE = 3.0, 0.2
"""Distance of the cameras from the origin, outside of a shape and inside of one, scene units; the shapes lie
in the unit ball.
"""
PIXEL_PARTS = 4
"""Parts of a pixel along each axis that its mean is taken over."""
STEPS, CLOSE = 128, 1e-5
"""Steps of the sphere tracing, and the distance at which a ray has met the surface."""
LIGHT = np.array([0.48, 0.6, 0.64])


def box(x: Array, half: tuple[float, float, float], center: tuple[float, float, float] = (0, 0, 0)) -> Array:
    beyond = np.abs(x - np.array(center)) - np.array(half)
    return np.linalg.norm(np.maximum(beyond, 0), axis=-1) + np.minimum(beyond.max(-1), 0)


def ball(x: Array, radius: float, center: tuple[float, float, float] = (0, 0, 0)) -> Array:
    return np.linalg.norm(x - np.array(center), axis=-1) - radius


def plate(x: Array) -> Array:
    """A square plate, 1.2 wide and 0.06 thick."""
    return box(x, (0.6, 0.6, 0.03))


def wire(x: Array) -> Array:
    """A straight wire, 1.2 long and 0.08 thick."""
    along = np.clip(x[..., :1], -0.6, 0.6) * np.array([1.0, 0.0, 0.0])
    return np.linalg.norm(x - along, axis=-1) - 0.04


def crevice(x: Array) -> Array:
    """Two boxes with a gap of 0.1 between them."""
    return np.minimum(box(x, (0.25, 0.5, 0.4), (-0.3, 0, 0)), box(x, (0.25, 0.5, 0.4), (0.3, 0, 0)))


def two_balls(x: Array) -> Array:
    """Two balls that touch at the origin."""
    return np.minimum(ball(x, 0.4, (-0.4, 0, 0)), ball(x, 0.4, (0.4, 0, 0)))


def bowl(x: Array) -> Array:
    """Half a shell, 0.12 thick, open above: the intersection's distance is exact but for its rim."""
    return np.maximum(np.abs(ball(x, 0.6)) - 0.06, x[..., 2])


def small(x: Array) -> Array:
    """A ball that fills a twentieth of the frame of `photograph`."""
    return ball(x, 0.23)


def block(x: Array) -> Array:
    """A cube, 1.1 wide."""
    return box(x, (0.55, 0.55, 0.55))


def room(x: Array) -> Array:
    """Everything outside of a box-shaped room, 1.2 wide and 1 high."""
    return -box(x, (0.6, 0.6, 0.5))


def antenna(x: Array) -> Array:
    """A ball with a wire as thin as a pixel of 64 across the frame: 0.4 long and 1/32 thick."""
    along = np.concatenate((np.zeros_like(x[..., :2]), np.clip(x[..., 2:], 0.4, 0.8)), -1)
    return np.minimum(ball(x, 0.4), np.linalg.norm(x - along, axis=-1) - 1 / 64)


SHAPES: Mapping[str, Distance] = {
    "thin plate": plate,
    "wire": wire,
    "crevice": crevice,
    "two touching balls": two_balls,
    "concave bowl": bowl,
    "a twentieth of the frame": small,
    "cube": block,
    "room": room,
    "ball with an antenna": antenna,
}


@dataclass(frozen=True)
class Seen:
    """Rays (N, 3) with `hit`, `position`, `normal`, and the observed linear radiance."""

    origins: Array
    directions: Array
    hit: Array
    position: Array
    normal: Array
    color: Array


def photograph(
    shape: Distance,
    count: int,
    views: int = 24,
    seed: int = 0,
    frame: float = 2.0,
    pixel: float = 0.0,
    inside: bool = False,
) -> Seen:
    """Random pixels of so many cameras around a shape.

    The radiance of the surface depends on position and normal only; pixels beside it are black.

    Args:
        frame: width of an image at the origin, scene units.
        pixel: width of a pixel there. Radiance and coverage are means over a pixel, and `hit` is a coverage
            of at least ½; position and normal are those of its centre.
        inside: the cameras stand near the origin and look away from it, with a field of view of 90°.
    """
    rng = np.random.default_rng(seed)
    turn = np.arange(views) * np.pi * (3 - np.sqrt(5))
    height = 0.9 * (1 - (2 * np.arange(views) + 1) / views)
    around = np.stack((np.cos(turn), np.sin(turn), height / np.sqrt(1 - height**2)), -1)
    around /= np.linalg.norm(around, axis=-1, keepdims=True)
    view = rng.integers(views, size=count)
    right = np.cross(around, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right, axis=-1, keepdims=True)
    right, down = right[view], np.cross(right, around)[view]
    origins = (INSIDE if inside else CAMERAS) * around[view]
    middle = (1.0 + INSIDE) * around[view] if inside else np.zeros((count, 3))
    across, up = rng.uniform(-frame / 2, frame / 2, (2, count, 1))

    def through(offset: Array) -> Seen:
        target = middle + (across + offset[0]) * right + (up + offset[1]) * down
        return meet(shape, origins, target - origins)

    seen = through(np.zeros(2))
    if not pixel:
        return seen
    parts = pixel * ((np.arange(PIXEL_PARTS) + 0.5) / PIXEL_PARTS - 0.5)
    beside = [through(np.array([x, y])) for x in parts for y in parts]
    covered = np.mean([part.hit for part in beside], 0) >= 0.5
    return replace(seen, hit=covered, color=np.mean([part.color for part in beside], 0))


def meet(shape: Distance, origins: Array, directions: Array) -> Seen:
    """What rays of any length see: the hits by sphere tracing, and their radiance."""
    directions = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    distance = np.maximum(np.linalg.norm(origins, axis=-1) - 1.5, 0.0)
    for _ in range(STEPS):
        distance = distance + np.minimum(shape(origins + distance[:, None] * directions), 0.5)
    position = origins + distance[:, None] * directions
    hit = np.abs(shape(position)) < 100 * CLOSE
    normal = np.where(hit[:, None], gradient(shape, position), 0.0)
    color = (0.5 + 0.3 * np.sin(5 * position)) * (0.4 + 0.6 * np.maximum(normal @ LIGHT, 0))[:, None]
    return Seen(origins, directions, hit, position, normal, np.where(hit[:, None], color, 0.0))


def gradient(shape: Distance, position: Array) -> Array:
    """The unit gradient by central differences."""
    step = CLOSE * np.eye(3)
    slope = np.stack([shape(position + axis) - shape(position - axis) for axis in step], -1)
    return slope / np.maximum(np.linalg.norm(slope, axis=-1, keepdims=True), 1e-12)
