"""Batches of other training loops: make a `PixelBatch` from their tensors; check shapes, types, devices."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from neilfpp_method.errors import UserError
from neilfpp_method.schedule import Stage
from neilfpp_method.structures import PixelBatch

__all__ = ["check_batch", "check_like", "check_points", "check_rows", "check_step", "pixel_batch"]


def pixel_batch(origins: Tensor, directions: Tensor, color: Tensor, mask: Tensor | None = None) -> PixelBatch:
    """Make a `PixelBatch` from the tensors of another training loop.

    Args:
        origins: ray origins (N, 3), scene frame.
        directions: unit ray directions (N, 3).
        color: pixel values (N, 3), linear or sRGB as declared to `attach_neilf`.
        mask: 1 on the object and 0 off it (N,), numbers or booleans. None: all pixels may show the object.

    Raises:
        UserError: a tensor has another shape, or holds integers.
    """
    for name, rows in {"origins": origins, "directions": directions, "color": color}.items():
        check_rows(name, rows, len(origins), 3)
    if isinstance(mask, Tensor) and mask.dtype == torch.bool:
        mask = mask.to(origins.dtype)
    if mask is not None:
        check_rows("mask", mask, len(origins))
    zeros, ones = torch.zeros_like(origins[:, 0]), torch.ones_like(origins[:, 0])
    return PixelBatch(
        origins=origins,
        directions=directions,
        color=color,
        mask=ones if mask is None else mask,
        mask_known=zeros if mask is None else ones,
        image_gradient=zeros,
        view=zeros.long(),
    )


def check_batch(batch: Any) -> None:
    """Check shapes and types of a batch; cheap enough for every step.

    Raises:
        UserError: it is no `PixelBatch`, or a tensor has integers or another shape than one row per pixel.
    """
    if not isinstance(batch, PixelBatch):
        raise UserError(f"the batch is a {type(batch).__name__}", "make one with attach.pixel_batch")
    for name in ("origins", "directions", "color"):
        check_rows(name, getattr(batch, name), len(batch), 3)
    for name in ("mask", "mask_known", "image_gradient"):
        check_rows(name, getattr(batch, name), len(batch))


def check_step(step: Any) -> None:
    """Check that a step is its index, counted from 0, or the name of a stage.

    Raises:
        UserError: it is not.
    """
    stages = [stage.value for stage in Stage]
    remedy = f"give the index of the step, or one of {', '.join(stages)}"
    if isinstance(step, str):
        if step not in stages:
            raise UserError(f"unknown stage '{step}'", remedy)
        return
    try:
        number = int(step)
    except (TypeError, ValueError, OverflowError) as error:
        raise UserError(f"the step is {step!r}", remedy) from error
    if number < 0:
        raise UserError(f"step {number}", "count steps from 0")


def check_rows(name: str, value: Any, count: int, width: int | None = None) -> None:
    """Check that a tensor has one row of floating-point numbers per pixel.

    Args:
        name: name of the tensor in messages.
        value: the tensor.
        count: number of pixels.
        width: numbers per pixel, in a second axis; None: one number per pixel without a second axis.

    Raises:
        UserError: it does not.
    """
    if not isinstance(value, Tensor):
        raise UserError(f"{name} of the batch is a {type(value).__name__}", "give a tensor: torch.as_tensor")
    if not value.is_floating_point():
        remedy = (
            "divide 8-bit pixels by 255 and attach with response='srgb'" if name == "color" else "give floats"
        )
        raise UserError(f"{name} of the batch is {value.dtype}", remedy)
    wanted = (count,) if width is None else (count, width)
    if tuple(value.shape) != wanted:
        pixels = math.prod(value.shape[:-1]) if width is not None and value.ndim > 2 else count
        shape = (
            f"({pixels}, {width}): one row per pixel, reshape(-1, {width})"
            if width
            else f"({pixels},): one number per pixel"
        )
        raise UserError(f"{name} of the batch has the shape {tuple(value.shape)}", f"give {shape}")


def check_points(name: str, x: Any, axes: int = 2) -> None:
    """Check that points are (N, 3), or with `axes` = 3 directions (N, S, 3), of floating-point numbers.

    Raises:
        UserError: they have another shape, or are integers.
    """
    if not isinstance(x, Tensor):
        raise UserError(f"{name} is a {type(x).__name__}", "give a tensor: torch.as_tensor")
    wanted = "(N, 3)" if axes == 2 else "(N, S, 3)"
    if x.ndim != axes or x.shape[-1] != 3:
        flat = f"{name}.reshape(-1, 3)" if axes == 2 and x.shape[-1:] == (3,) else f"the shape {wanted}"
        raise UserError(f"{name} has the shape {tuple(x.shape)}, not {wanted}", f"give {flat}")
    if not x.is_floating_point():
        raise UserError(f"{name} is {x.dtype}", "give floats")


def check_like(name: str, value: Tensor, own: Tensor) -> None:
    """Check that a tensor has the device and the type of the parameters of material and light.

    Args:
        name: name of the tensor in messages.
        value: the tensor.
        own: a parameter.

    Raises:
        UserError: it does not, or the parameters are in half precision.
    """
    if own.dtype in (torch.float16, torch.bfloat16):
        raise UserError(
            f"material and light are {own.dtype}, which is too coarse for positions",
            "convert them with neilf.float(), and use torch.autocast for speed",
        )
    if value.device != own.device:
        devices = f"{name} on {value.device}, material and light on {own.device}"
        raise UserError(devices, "move one of them, for example neilf.to(device)")
    if value.dtype != own.dtype:
        dtypes = f"{name} {'are' if name == 'rays' else 'is'} {value.dtype}, material and light {own.dtype}"
        raise UserError(dtypes, f"give {name}.float(), or convert the other with neilf.double()")
