"""What goes wrong when a host first meets the method: looked for in the first batches, said once.

An error where nothing right can come of it; a warning where it may be meant.
"""

from __future__ import annotations

import logging
import math

import torch
from torch import Tensor

from neilfpp_method.errors import UserError
from neilfpp_method.shading.color import apply_response
from neilfpp_method.structures import PixelBatch, SurfaceHits

__all__ = ["FirstLook", "check_batch", "check_points", "check_rows"]

BATCHES = 10
"""Batches that are looked at; each look waits for the device."""
UNIT = 1e-3
"""Most that the length of a direction may differ from 1."""
OFF_RAY = 0.02
"""How far a hit may lie beside its ray, in shares of its distance."""
MAX_OFF = 0.5
"""Share of hits that may be off their rays or turned away: blended hits at edges are, a few."""
REACH = 1.5
"""Distance from the centre at which positions are outside the scene, scene units; a ground has room."""
SIZES = 30.0
"""Factor between the median of the pixels and `median_radiance` that no exposure explains."""

log = logging.getLogger(__name__)


class FirstLook:
    """Looks at the first batches.

    Args:
        name: of the host.
        hit_share: least concentration of a hit.
        response: what the pixels are, "linear" or "srgb".
        median_radiance: median linear luminance of the object, as the caller says.
    """

    def __init__(self, name: str, hit_share: float, response: str, median_radiance: float) -> None:
        self.name = name
        self.hit_share = hit_share
        self.response = response
        self.median_radiance = median_radiance
        self.batches = 0
        self.any_hit = False
        self._said: set[str] = set()

    @property
    def over(self) -> bool:
        """Whether enough was seen."""
        return self.batches >= BATCHES

    def pixels(self, batch: PixelBatch) -> None:
        """Look at a batch before the host is asked.

        Raises:
            UserError: pixels or rays that cannot be used.
        """
        if self.over:
            return
        length = batch.directions.norm(dim=-1)
        worst = (length - 1.0).abs().max().item() if len(batch) else 0.0
        if not worst <= UNIT:
            raise UserError(
                f"directions of rays are no unit vectors: the lengths go from {length.min():.3g} to "
                f"{length.max():.3g}",
                "divide them by their lengths, so that a distance along a ray is a length",
            )
        for name in ("origins", "color"):
            rows = ~getattr(batch, name).isfinite().all(-1)
            if rows.any():
                raise UserError(
                    f"{name} of {int(rows.sum())} of {len(batch)} pixels are not finite",
                    "leave those pixels out",
                )
        self._look_at_colors(batch.color[batch.mask > 0.5])

    def hits(self, batch: PixelBatch, hits: SurfaceHits) -> None:
        """Look at what the host says of a batch.

        Raises:
            UserError: hits that cannot be used.
        """
        if self.over:
            return
        self.batches += 1
        hit = hits.is_hit(self.hit_share).detach()
        for name in ("color", "position"):
            rows = ~getattr(hits, name).detach().isfinite().all(-1)
            if rows.any():
                raise UserError(
                    f"{self.name}: its {name} is not finite for {int(rows.sum())} of {len(batch)} rays",
                    "return zeros, and the concentration 0, where a ray meets nothing; look for a division "
                    "by zero elsewhere",
                )
        self.any_hit = self.any_hit or bool(hit.any())
        if hit.any():
            self._look_at_surface(batch, hits.detach(), hit)
            self._look_at_median(batch.color[hit])
        elif not self.any_hit:
            self._say(
                "no hit",
                f"none of {len(batch)} rays meets a surface, so nothing is learned of them",
                "is the frame of the rays the host's, the object in the unit sphere? A hit has a "
                f"concentration of {self.hit_share} or more (of a function: a normal)",
            )

    def _look_at_colors(self, color: Tensor) -> None:
        if len(color) == 0:
            return
        if color.min() < -1e-3 * self.median_radiance:
            self._say(
                "negative", "some pixels are negative", "give linear radiance or display values, 0 and above"
            )
        if self.response == "srgb" and color.max() > 1.001:
            raise UserError(
                f"pixels reach {color.max():.3g}, and display values end at 1",
                "divide 8-bit pixels by 255, or attach with response='linear' if these are radiance",
            )

    def _look_at_median(self, color: Tensor) -> None:
        median = color.mean(-1).median().item()
        told = apply_response(torch.tensor(self.median_radiance), self.response).item()
        if median > 0 and not 1 / SIZES < median / told < SIZES:
            self._say(
                "median",
                f"the median of the pixels is {median:.3g}, median_radiance says {told:.3g}",
                "give attach_neilf the median_radiance of your images; 8-bit pixels are to be divided by 255",
            )

    def _look_at_surface(self, batch: PixelBatch, hits: SurfaceHits, hit: Tensor) -> None:
        offset = (hits.position - batch.origins)[hit]
        directions = batch.directions[hit]
        depth = (offset * directions).sum(-1)
        beside = (offset - depth[:, None] * directions).norm(dim=-1)
        off = ((beside > OFF_RAY * offset.norm(dim=-1)) | (depth <= 0)).float().mean().item()
        if off > MAX_OFF:
            raise UserError(
                f"{self.name}: {off:.0%} of its hits do not lie on their rays",
                "return positions in the frame of the rays, origin + distance · direction, with unit "
                "directions",
            )
        away = ((hits.normal[hit] * directions).sum(-1) > 0).float().mean().item()
        if away > MAX_OFF:
            raise UserError(
                f"{self.name}: {away:.0%} of its normals point away from the viewer",
                "turn them outwards: normal = -normal",
            )
        reach = hits.position[hit].norm(dim=-1).median().item()
        if reach > REACH:
            self._say(
                "far",
                f"half of its hits lie {reach:.3g} and more from the origin; material and light know the "
                "unit sphere",
                "move and scale cameras and host so that the object lies in the unit sphere",
            )

    def _say(self, what: str, problem: str, remedy: str) -> None:
        if what not in self._said:
            self._said.add(what)
            log.warning("%s: %s; %s", self.name, problem, remedy)


def check_batch(batch: PixelBatch) -> None:
    """Shapes and types of a batch, at every step: that costs nothing.

    Raises:
        UserError: integers for pixels, or a shape that repeats rows.
    """
    for name in ("origins", "directions", "color"):
        check_rows(name, getattr(batch, name), len(batch), 3)
    for name in ("mask", "mask_known", "image_gradient"):
        check_rows(name, getattr(batch, name), len(batch))


def check_rows(name: str, value: Tensor, count: int, width: int | None = None) -> None:
    """That there is a row per pixel, of floats.

    Args:
        name: of what it is.
        value: to look at.
        count: of pixels.
        width: numbers of a pixel; none: one, without an axis of its own.

    Raises:
        UserError: there is not.
    """
    if not value.is_floating_point():
        remedy = (
            "divide 8-bit pixels by 255 and attach with response='srgb'" if name == "color" else "give floats"
        )
        raise UserError(f"{name} of the batch is {value.dtype}", remedy)
    wanted = (count,) if width is None else (count, width)
    if tuple(value.shape) != wanted:
        pixels = math.prod(value.shape[:-1]) if width is not None and value.ndim > 2 else count
        shape = (
            f"({pixels}, {width}): a row per pixel, reshape(-1, {width})"
            if width
            else f"({pixels},): a number per pixel"
        )
        raise UserError(f"{name} of the batch has the shape {tuple(value.shape)}", f"give {shape}")


def check_points(name: str, x: Tensor, axes: int = 2) -> None:
    """That points, or directions at them, come in rows.

    Raises:
        UserError: another shape, or integers.
    """
    wanted = "(N, 3)" if axes == 2 else "(N, S, 3)"
    if x.ndim != axes or x.shape[-1] != 3:
        flat = f"{name}.reshape(-1, 3)" if axes == 2 and x.shape[-1:] == (3,) else f"the shape {wanted}"
        raise UserError(f"{name} has the shape {tuple(x.shape)}, not {wanted}", f"give {flat}")
    if not x.is_floating_point():
        raise UserError(f"{name} is {x.dtype}", "give floats")
