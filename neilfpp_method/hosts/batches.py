"""Batches of other training loops: make a `PixelBatch` from their tensors; check shapes, types, devices."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from neilfpp_method.errors import UserError
from neilfpp_method.structures import PixelBatch, RayBatch

__all__ = ["check_batch", "check_device_and_dtype", "check_points", "pixel_batch"]


def pixel_batch(origins: Tensor, directions: Tensor, color: Tensor, mask: Tensor | None = None) -> PixelBatch:
    """Make a `PixelBatch` from the tensors of another training loop.

    Args:
        origins: ray origins (N, 3), scene frame.
        directions: unit ray directions (N, 3).
        color: pixel values (N, 3), linear or sRGB as declared to `attach_neilf`.
        mask: 1 on the object and 0 off it (N,). None: all pixels may show the object.

    Raises:
        UserError: a tensor has another shape, or holds integers.
    """
    for name, rows in {"origins": origins, "directions": directions, "color": color}.items():
        _check_rows(name, rows, len(origins), 3)
    if mask is not None:
        _check_rows("mask", mask, len(origins))
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


def check_batch(batch: PixelBatch) -> None:
    """Check shapes and types of a batch; cheap enough for every step.

    Raises:
        UserError: a tensor has integers, or another shape than one row per pixel.
    """
    for name in ("origins", "directions", "color"):
        _check_rows(name, getattr(batch, name), len(batch), 3)
    for name in ("mask", "mask_known", "image_gradient"):
        _check_rows(name, getattr(batch, name), len(batch))


def check_device_and_dtype(rays: RayBatch, field: nn.Module) -> None:
    """Check that rays are on the device and of the type of a field's parameters.

    Raises:
        UserError: they are not.
    """
    own = next(field.parameters())
    if rays.origins.device != own.device:
        devices = f"rays on {rays.origins.device}, material and light on {own.device}"
        raise UserError(devices, "move one of them, for example neilf.to(device)")
    if rays.origins.dtype != own.dtype:
        dtypes = f"rays are {rays.origins.dtype}, material and light {own.dtype}"
        raise UserError(dtypes, "give rays.float(), or convert the other with neilf.double()")


def check_points(name: str, x: Tensor, axes: int = 2) -> None:
    """Check that points are (N, 3), or with `axes` = 3 directions (N, S, 3), of floating-point numbers.

    Raises:
        UserError: they have another shape, or are integers.
    """
    wanted = "(N, 3)" if axes == 2 else "(N, S, 3)"
    if x.ndim != axes or x.shape[-1] != 3:
        flat = f"{name}.reshape(-1, 3)" if axes == 2 and x.shape[-1:] == (3,) else f"the shape {wanted}"
        raise UserError(f"{name} has the shape {tuple(x.shape)}, not {wanted}", f"give {flat}")
    if not x.is_floating_point():
        raise UserError(f"{name} is {x.dtype}", "give floats")


def _check_rows(name: str, value: Tensor, count: int, width: int | None = None) -> None:
    """Check that a tensor has one row of floating-point numbers per pixel.

    Args:
        name: name of the tensor in messages.
        value: the tensor.
        count: number of pixels.
        width: numbers per pixel, in a second axis; None: one number per pixel without a second axis.

    Raises:
        UserError: it does not.
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
            f"({pixels}, {width}): one row per pixel, reshape(-1, {width})"
            if width
            else f"({pixels},): one number per pixel"
        )
        raise UserError(f"{name} of the batch has the shape {tuple(value.shape)}", f"give {shape}")
