"""Check the outputs of a host: shapes, types, devices, normals and gradients."""

from __future__ import annotations

import logging
from dataclasses import fields
from typing import Any

import torch
from torch import Tensor

from neilfpp_method.errors import UserError
from neilfpp_method.structures import RayBatch, SurfaceHits

__all__ = ["MAX_MEDIAN_DISTANCE", "OutputCheck", "check_normals", "check_tensors", "host_name"]

SHAPES = {"color": (3,), "position": (3,), "normal": (3,), "opacity": (), "concentration": ()}
"""Shape of one row of each output."""
UNIT_TOLERANCE = 1e-2
"""Largest difference of the length of a normal from 1: blending in half precision loses some digits."""
MAX_MEDIAN_DISTANCE = 1.5
"""Median distance of hits from the origin above which the scene is too large, scene units. An object in the
unit sphere may stand on a ground.
"""

log = logging.getLogger(__name__)


class OutputCheck:
    """Rejects invalid outputs of a host.

    Shapes, types, devices and the gradient graph are checked in every step, without synchronising with the
    device. Normals are checked until a batch with a hit has passed; the training loop handles later values
    that are not finite.

    Args:
        host: the host whose outputs are checked.
        hit_share: smallest concentration of a hit.
        may_be_constant: whether the host may have nothing to train, as a function or a frozen model.
    """

    def __init__(self, host: object, hit_share: float, may_be_constant: bool = False) -> None:
        self.name = host_name(host)
        self.hit_share = hit_share
        self.may_be_constant = may_be_constant
        self.normals_known = False
        self._warned_of_constant = False

    def __call__(self, rays: RayBatch, hits: Any, trains_color: bool) -> None:
        """Check the output of one call.

        Args:
            rays: the rays that were rendered.
            hits: what the host returned, `SurfaceHits` if the host is correct.
            trains_color: whether the colour should carry a gradient to the host.

        Raises:
            UserError: an output is invalid; the message names host, output and remedy.
        """
        check_tensors(self.name, rays, {f.name: getattr(hits, f.name, None) for f in fields(SurfaceHits)})
        if trains_color and not hits.color.requires_grad:
            self._constant_color()
        if not self.normals_known:
            self.normals_known = check_normals(self.name, hits, self.hit_share)

    def _constant_color(self) -> None:
        """Report a colour without gradient in a stage that trains the host."""
        problem = f"{self.name}: its color has no gradient to the host's parameters, which this stage trains"
        remedy = "render without torch.no_grad and without detach"
        if not self.may_be_constant:
            raise UserError(problem, f"{remedy}, or set train.joint_steps to 0")
        if not self._warned_of_constant:
            self._warned_of_constant = True
            log.warning("%s: only material and light are trained; to train the host, %s", problem, remedy)


def host_name(host: object) -> str:
    """Name of a host in messages: its `name` attribute, else its class."""
    name = getattr(host, "name", None)
    return name if isinstance(name, str) else type(host).__name__


def check_tensors(name: str, rays: RayBatch, outputs: dict[str, object]) -> None:
    """Check that outputs are floating-point tensors of the required shapes on the device of the rays.

    Raises:
        UserError: one of them is not.
    """
    for output, value in outputs.items():
        wanted = (len(rays), *SHAPES[output])
        if not isinstance(value, Tensor) or not value.is_floating_point():
            kind = str(value.dtype) if isinstance(value, Tensor) else type(value).__name__
            raise UserError(
                f"{name}: its {output} is a {kind}", f"return a floating-point tensor {_shape(wanted)}"
            )
        if tuple(value.shape) != wanted:
            shape = f"the shape {_shape(value.shape)}"
            raise UserError(f"{name}: its {output} has {shape}", f"return {_shape(wanted)}, a row per ray")
        if value.device != rays.origins.device:
            raise UserError(
                f"{name}: its {output} is on {value.device}, the rays are on {rays.origins.device}",
                "move the host, or the batch, to the device of the other",
            )


def check_normals(name: str, hits: SurfaceHits, hit_share: float) -> bool:
    """Check that normals are finite, and unit vectors where a ray hits.

    Returns:
        Whether there was a hit, so that the lengths could be checked.

    Raises:
        UserError: normals are not finite or not unit.
    """
    normal = hits.normal.detach()
    if not normal.isfinite().all():
        rows = int((~normal.isfinite()).any(-1).sum())
        raise UserError(
            f"{name}: its normal is not finite for {rows} of {len(normal)} rays",
            "divide by the length with a lower bound, and return zeros for rays that miss",
        )
    length = normal[hits.is_hit(hit_share)].norm(dim=-1)
    # The normals of both faces of a thin sheet may cancel: zero normals are allowed unless most are zero.
    off = (length - 1.0).abs()
    wrong = off.where(length > 0.0, off.median()) if len(length) else off
    if len(length) and wrong.max() > UNIT_TOLERANCE:
        odd = length[wrong.argmax()].item()
        raise UserError(
            f"{name}: its normal is not a unit vector: that of a hit has the length {odd:.3g}",
            "divide it by its length, and set the concentration of rays that miss to 0",
        )
    return len(length) > 0


def _shape(sizes: tuple[int, ...] | torch.Size) -> str:
    return "(" + ", ".join(map(str, sizes)) + ("," if len(sizes) == 1 else "") + ")"
