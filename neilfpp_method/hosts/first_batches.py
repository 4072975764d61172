"""Check the first batches of an attached host for common mistakes.

A mistake that makes the result wrong is an error. Something that may be intended is a warning, given once.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable

import torch
from torch import Tensor

from neilfpp_method.errors import UserError
from neilfpp_method.hosts.other_viewpoints import (
    SAME_POINT,
    START_DISTANCE,
    OtherViewpoints,
    other_viewpoints,
)
from neilfpp_method.hosts.outputs import MAX_MEDIAN_DISTANCE
from neilfpp_method.settings.facts import SceneFacts
from neilfpp_method.shading.color import apply_response
from neilfpp_method.structures import OrientedPoints, PixelBatch, RayBatch, SurfaceHits

__all__ = ["FirstBatches"]

BATCHES = 10
"""Number of batches that are checked; each check synchronises with the device."""
UNIT_TOLERANCE = 1e-3
"""Largest difference of the length of a direction from 1."""
OFF_RAY = 0.02
"""Distance of a hit from its ray, relative to its distance from the origin of the ray, above which the hit is
wrong. `check_host` permits only half of it, and no exceptions.
"""
MAX_WRONG_SHARE = 0.5
"""Largest permitted share of hits that are off their rays or have normals that face away from the viewer.
Blending over two surfaces causes a few such hits in a correct host.
"""
LOST_DISTANCE = 10.0
"""Median distance of hits from the origin above which nothing can be estimated: the fields of material and
light end at the scene's bounding box, `background.radius`.
"""
MAX_LOST_SHARE = 0.02
"""Largest share of hits beyond `LOST_DISTANCE`. More of them are a background that counts as a surface."""
BACKGROUND_MISSES = "give its rays a concentration of 0, and for a function a normal of 0"
"""Remedy for a background that counts as a surface."""
MAX_REVIEWED_HITS = 256
"""Maximum number of hits that are rendered from another viewpoint, once."""
MAX_MOVED_SHARE = 0.4
"""Largest share of hits that may be lost or elsewhere when seen from another viewpoint; some are occluded."""
MAX_MEDIAN_RATIO = 30.0
"""Factor between the median of the pixels and `median_radiance` above which one of them is probably wrong."""

log = logging.getLogger(__name__)


class FirstBatches:
    """Checks the first batches and their hits.

    Args:
        name: name of the host in messages.
        hit_share: smallest concentration of a hit.
        facts: meaning of pixel values, and median linear luminance of the object.
        render: renders any rays with the host, to compare its hits from two viewpoints; if None, they are not
            compared.
        traced_by_host: whether the host itself renders the rays that start on its surface. If so, its hits
            are compared from close by as well.
    """

    def __init__(
        self,
        name: str,
        hit_share: float,
        facts: SceneFacts,
        render: Callable[[RayBatch], SurfaceHits] | None = None,
        traced_by_host: bool = False,
    ) -> None:
        self.name = name
        self.hit_share = hit_share
        self.facts = facts
        self.render = render
        self.traced_by_host = traced_by_host
        self.batches = 0
        self.any_hit = False
        self._warned: set[str] = set()

    @property
    def over(self) -> bool:
        """Whether enough batches have been checked."""
        return self.batches >= BATCHES

    def pixels(self, batch: PixelBatch) -> None:
        """Check a batch before the host renders it.

        Raises:
            UserError: pixels or rays cannot be used.
        """
        if self.over:
            return
        length = batch.directions.norm(dim=-1)
        worst = (length - 1.0).abs().max().item() if len(batch) else 0.0
        if not worst <= UNIT_TOLERANCE:
            raise UserError(
                f"ray directions are not unit vectors: their lengths are between {length.min():.3g} and "
                f"{length.max():.3g}",
                "divide them by their lengths",
            )
        for name in ("origins", "color"):
            rows = ~getattr(batch, name).isfinite().all(-1)
            if rows.any():
                raise UserError(
                    f"{name} of {int(rows.sum())} of {len(batch)} pixels are not finite",
                    "leave those pixels out",
                )
        if len(batch) and not (batch.mask.min() >= 0 and batch.mask.max() <= 1):
            raise UserError(
                f"mask is between {batch.mask.min():.3g} and {batch.mask.max():.3g}",
                "give 1 on the object and 0 off it; divide 8-bit masks by 255",
            )
        self._check_colors(batch.color[batch.mask > 0.5])

    def hits(self, batch: PixelBatch, hits: SurfaceHits) -> None:
        """Check the hits of a batch.

        Raises:
            UserError: hits cannot be used.
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
                    "return zeros and concentration 0 for a ray that misses; otherwise look for a division "
                    "by zero",
                )
        is_first = bool(hit.any()) and not self.any_hit
        self.any_hit = self.any_hit or is_first
        if hit.any():
            self._check_surface(batch, hits.detach(), hit)
            if is_first and self.render is not None:
                self._check_another_view(batch, hits.detach(), hit, self.render)
            self._check_median(batch.color[hit])
        elif not self.any_hit:
            self._warn(
                "no hit",
                f"none of {len(batch)} rays hits a surface, so material and light are not trained",
                "are the rays in the host's frame, with the object in the unit sphere? A hit has a "
                f"concentration of at least {self.hit_share} (for a function: a normal that is not zero)",
            )

    def _check_colors(self, color: Tensor) -> None:
        if len(color) == 0:
            return
        if color.min() < -1e-3 * self.facts.median_radiance:
            self._warn(
                "negative", "some pixels are negative", "give linear radiance or display values, 0 and above"
            )
        if self.facts.response == "srgb" and color.max() > 1.001:
            raise UserError(
                f"pixels reach {color.max():.3g}, but display values are at most 1",
                "divide 8-bit pixels by 255, or attach with response='linear' if these are radiance",
            )

    def _check_median(self, color: Tensor) -> None:
        median = color.mean(-1).median().item()
        expected = apply_response(torch.tensor(self.facts.median_radiance), self.facts.response).item()
        if median > 0 and not 1 / MAX_MEDIAN_RATIO < median / expected < MAX_MEDIAN_RATIO:
            self._warn(
                "median",
                f"the median of the pixels is {median:.3g}, but median_radiance means {expected:.3g}",
                "give attach_neilf the median_radiance of your images, and divide 8-bit pixels by 255",
            )

    def _check_surface(self, batch: PixelBatch, hits: SurfaceHits, hit: Tensor) -> None:
        offset = (hits.position - batch.origins)[hit]
        directions = batch.directions[hit]
        depth = (offset * directions).sum(-1)
        beside = (offset - depth[:, None] * directions).norm(dim=-1)
        off = ((beside > OFF_RAY * offset.norm(dim=-1)) | (depth <= 0)).float().mean().item()
        if off > MAX_WRONG_SHARE:
            raise UserError(
                f"{self.name}: {off:.0%} of its hits do not lie on their rays",
                "return positions in the frame of the rays, origin + distance · direction, with unit "
                "directions",
            )
        away = ((hits.normal[hit] * directions).sum(-1) > 0).float().mean().item()
        if away > MAX_WRONG_SHARE:
            raise UserError(
                f"{self.name}: {away:.0%} of its normals point away from the viewer",
                "turn them outwards: normal = -normal",
            )
        distance = hits.position[hit].norm(dim=-1)
        reach = distance.median().item()
        lost = (distance > LOST_DISTANCE).float().mean().item()
        far = f"half of its hits are {reach:.3g} or more from the origin"
        remedy = "move and scale cameras and host so that the object lies in the unit sphere"
        if reach > LOST_DISTANCE:
            background = f"if most rays show a distant background, {BACKGROUND_MISSES}"
            raise UserError(f"{self.name}: {far}", f"{remedy} (docs/hosts.md, Other units); {background}")
        if reach > MAX_MEDIAN_DISTANCE:
            self._warn("far", far, remedy)
        elif lost > MAX_LOST_SHARE:
            self._warn(
                "background",
                f"{lost:.0%} of its hits are {LOST_DISTANCE:g} or more from the origin, and their material "
                "is trained as if they were a surface of the object",
                f"if they are a distant background, {BACKGROUND_MISSES}",
            )

    @torch.no_grad()
    def _check_another_view(
        self,
        batch: PixelBatch,
        hits: SurfaceHits,
        hit: Tensor,
        render: Callable[[RayBatch], SurfaceHits],
    ) -> None:
        """Compare hits with those from other viewpoints at the same distance; a wrong depth moves them.

        The random state of the caller is not changed.
        """
        rows = torch.nonzero(hit)[:, 0]
        rows = rows[:: math.ceil(len(rows) / MAX_REVIEWED_HITS)]
        others = other_viewpoints(batch.rays[rows], OrientedPoints(hits.position[rows], hits.normal[rows]))
        moved = self._share_moved(others, others.distance, render)
        if moved > MAX_MOVED_SHARE:
            self._warn(
                "moved",
                f"{moved:.0%} of its hits are {SAME_POINT} or more away when seen from another viewpoint",
                "return distances along the unit ray, not z-depths; a host that is still being trained may "
                "have no surface yet",
            )
        elif self.traced_by_host:
            moved = self._share_moved(others, torch.full_like(others.distance, START_DISTANCE), render)
            if moved > MAX_MOVED_SHARE:
                self._warn(
                    "near plane",
                    f"{moved:.0%} of its hits are lost when seen from {START_DISTANCE} away, and so is "
                    "the light that surfaces close to each other exchange",
                    "render rays that start on a surface without a near plane, or set light.inter_reflection "
                    "to 'hard', so that a proxy of the surface traces them (docs/hosts.md)",
                )

    def _share_moved(
        self, others: OtherViewpoints, distance: Tensor, render: Callable[[RayBatch], SurfaceHits]
    ) -> float:
        """The share of hits that are lost or elsewhere when they are rendered from these distances."""
        with torch.random.fork_rng(devices=[distance.device] if distance.is_cuda else []):
            again = render(others.rays(distance))
        offset = (again.position - others.position).norm(dim=-1)
        same = again.is_hit(self.hit_share) & (offset < SAME_POINT)
        return 1.0 - same.float().mean().item()

    def _warn(self, kind: str, problem: str, remedy: str) -> None:
        if kind not in self._warned:
            self._warned.add(kind)
            log.warning("%s: %s; %s", self.name, problem, remedy)
