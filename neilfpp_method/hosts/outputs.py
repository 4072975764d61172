"""What a host must hand out, and the line that a person reads when it does not."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import torch
from torch import Tensor

from neilfpp_method.errors import UserError
from neilfpp_method.structures import RayBatch, SurfaceHits

__all__ = ["OutputCheck", "check_normals", "check_tensors", "host_name"]

SHAPES = {"color": (3,), "position": (3,), "normal": (3,), "opacity": (), "concentration": ()}
UNIT = 1e-2
"""Most that the length of a normal may differ from 1: blending in half precision costs some digits."""


class OutputCheck:
    """Refuses what a host must not return.

    Shapes, devices and graphs are looked at in every step and cost nothing. Normals are looked at until a
    first hit was among them: after that, a step that is not finite is the training loop's affair.
    """

    def __init__(self, host: object, hit_share: float) -> None:
        self.name = host_name(host)
        self.hit_share = hit_share
        self.normals_known = False

    def __call__(self, rays: RayBatch, hits: Any, color_moves: bool) -> None:
        """Look at what `rays` brought.

        Args:
            rays: what the host was asked.
            hits: what it answered: `SurfaceHits`, if all is well.
            color_moves: a loss on the colour is about to send a gradient into the host.

        Raises:
            UserError: names the host, the output and the remedy.
        """
        check_tensors(self.name, rays, {f.name: getattr(hits, f.name, None) for f in fields(SurfaceHits)})
        if color_moves and not hits.color.requires_grad:
            raise UserError(
                f"{self.name}: the colour is cut off from the host's parameters, and this stage trains them",
                "render without torch.no_grad and detach, or set train.joint_steps to 0",
            )
        if not self.normals_known:
            self.normals_known = check_normals(self.name, hits, self.hit_share)


def host_name(host: object) -> str:
    """The class of a host, or the name of the function that is one."""
    name = getattr(host, "name", None)
    return name if isinstance(name, str) else type(host).__name__


def check_tensors(name: str, rays: RayBatch, outputs: dict[str, object]) -> None:
    """That outputs are floating-point tensors of the contract's shapes, on the device of the rays.

    Raises:
        UserError: one is not.
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
    """That normals are finite, and unit where a ray hits; whether a hit was there to tell by.

    Raises:
        UserError: they are not.
    """
    normal = hits.normal.detach()
    if not normal.isfinite().all():
        rows = int((~normal.isfinite()).any(-1).sum())
        raise UserError(
            f"{name}: its normal is not finite for {rows} of {len(normal)} rays",
            "divide by the length with a floor under it, and return zeros where a ray meets nothing",
        )
    length = normal[hits.is_hit(hit_share)].norm(dim=-1)
    # Where a ray meets both faces of a thin sheet, normals may cancel: zeros are excused unless most are.
    off = (length - 1.0).abs()
    wrong = off.where(length > 0.0, off.median()) if len(length) else off
    if len(length) and wrong.max() > UNIT:
        odd = length[wrong.argmax()].item()
        raise UserError(
            f"{name}: its normal is no unit vector: that of a hit has the length {odd:.3g}",
            "divide it by its length, and give a ray that meets nothing the concentration 0",
        )
    return len(length) > 0


def _shape(sizes: tuple[int, ...] | torch.Size) -> str:
    return "(" + ", ".join(map(str, sizes)) + ("," if len(sizes) == 1 else "") + ")"
