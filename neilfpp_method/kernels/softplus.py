"""Softplus and its derivative by compiled loops on a CPU, where torch makes ten passes over memory."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import FunctionCtx
from torch.nn import functional

from neilfpp_method.kernels.loops import loops
from neilfpp_method.kernels.threads import for_each, shares

__all__ = ["UnitSample", "softplus", "softplus_and_slope"]

MIN_VALUES_PER_THREAD = 65_536
"""Minimum work of a thread, in numbers; below it, starting the thread costs more than it saves."""


@dataclass(frozen=True)
class UnitSample:
    """The values of hidden units at z, and their derivatives with respect to z."""

    value: Float[Tensor, "*S"]
    slope: Float[Tensor, "*S"]


def softplus(z: Float[Tensor, "*S"], sharpness: float) -> Float[Tensor, "*S"]:
    """ln(1 + e^(sharpness z)) / sharpness."""
    differentiated = torch.is_grad_enabled() and z.requires_grad
    if not _takes(z):
        return functional.softplus(z, beta=sharpness)
    if differentiated:
        return _differentiable(z, sharpness).value
    value = torch.empty_like(z, memory_format=torch.contiguous_format)
    _run("softplus", sharpness, z, value)
    return value


def softplus_and_slope(z: Float[Tensor, "*S"], sharpness: float) -> UnitSample:
    """Softplus and its derivative; both can be differentiated any number of times."""
    if not _takes(z):
        return UnitSample(functional.softplus(z, beta=sharpness), torch.sigmoid(sharpness * z))
    return _differentiable(z, sharpness)


# `torch.compile` cannot trace the loops.
@torch.compiler.disable
def _differentiable(z: Float[Tensor, "*S"], sharpness: float) -> UnitSample:
    return UnitSample(*_Softplus.apply(z, sharpness))


class _Softplus(torch.autograd.Function):
    @staticmethod
    def forward(ctx: FunctionCtx, z: Tensor, sharpness: float) -> tuple[Tensor, Tensor]:
        value, slope = (torch.empty_like(z, memory_format=torch.contiguous_format) for _ in range(2))
        _run("softplus_and_slope", sharpness, z, value, slope)
        ctx.save_for_backward(slope)
        ctx.sharpness = sharpness
        return value, slope

    @staticmethod
    def backward(ctx: FunctionCtx, to_value: Tensor, to_slope: Tensor) -> tuple[Tensor, None]:
        (slope,) = ctx.saved_tensors
        # Gradients are enabled if the gradient itself will be differentiated.
        if torch.is_grad_enabled():
            return slope * (to_value + to_slope * ctx.sharpness * (1.0 - slope)), None
        gradient = torch.empty_like(slope)
        _run("softplus_gradient", ctx.sharpness, slope, to_value, to_slope, gradient)
        return gradient, None


def _takes(z: Tensor) -> bool:
    """Whether the loops support this tensor; torch supports any."""
    return z.device.type == "cpu" and z.dtype == torch.float32 and loops() is not None


@torch.compiler.disable
def _run(loop: str, sharpness: float, *tensors: Tensor) -> None:
    work, arrays = getattr(loops(), loop), [_flat(tensor) for tensor in tensors]
    for_each(
        lambda start, stop: work(*arrays, sharpness, start, stop),
        shares(tensors[0].numel(), MIN_VALUES_PER_THREAD),
    )


def _flat(tensor: Tensor) -> np.ndarray:
    return tensor.detach().contiguous().view(-1).numpy()
