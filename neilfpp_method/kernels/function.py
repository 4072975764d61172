"""Connect kernels to autograd: the backend computes the first order, the reference all higher orders."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import FunctionCtx

from neilfpp_method.kernels import reference
from neilfpp_method.kernels.grid import Encoded, GridSpec

__all__ = ["Kernels", "OutputGradients", "encode_with", "fits"]


@dataclass(frozen=True)
class OutputGradients:
    """The gradients of a loss with respect to features and Jacobian of an encoding, in any memory order."""

    features: Float[Tensor, "N F"]
    jacobian: Float[Tensor, "N F 3"] | None


@dataclass(frozen=True)
class Kernels:
    """The functions of a backend, which are independent of autograd.

    Points and table are contiguous. All tensors have the same float type and are on the same device.
    """

    devices: tuple[str, ...]
    """The kinds of devices on which they run."""
    forward: Callable[[Tensor, Tensor, GridSpec, bool], Encoded]
    """Points, table → features and, on demand, the Jacobian."""
    table_gradient: Callable[[Tensor, GridSpec, OutputGradients], Tensor]
    """Points → the gradient with respect to the table."""
    point_gradient: Callable[[Tensor, Tensor, GridSpec, OutputGradients], Tensor]
    """Points, table → the gradient with respect to the points."""


def fits(x01: Tensor, table: Tensor) -> bool:
    """Whether kernels support these types: both float32, or both float64. The reference supports any."""
    return x01.dtype == table.dtype and table.dtype in (torch.float32, torch.float64)


# `torch.compile` cannot trace the kernels.
@torch.compiler.disable
def encode_with(
    kernels: Kernels, x01: Float[Tensor, "N 3"], table: Float[Tensor, "T F"], spec: GridSpec, jacobian: bool
) -> Encoded:
    """See `neilfpp_method.kernels.encode`.

    Raises:
        ValueError: if the table does not have the shape that `spec` requires; kernels do not check bounds.
    """
    if table.shape != (spec.entries, spec.features) or x01.device != table.device:
        raise ValueError(
            f"a table of {tuple(table.shape)} on {table.device} for {spec} and points on {x01.device}"
        )
    return Encoded(*_Encode.apply(x01, table, spec, jacobian, kernels))


class _Encode(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: FunctionCtx, x01: Tensor, table: Tensor, spec: GridSpec, jacobian: bool, kernels: Kernels
    ) -> tuple[Tensor, Tensor | None]:
        ctx.save_for_backward(x01, table)
        ctx.spec, ctx.kernels = spec, kernels
        encoded = kernels.forward(x01.contiguous(), table.contiguous(), spec, jacobian)
        return encoded.features, encoded.jacobian

    @staticmethod
    def backward(
        ctx: FunctionCtx, features: Tensor, jacobian: Tensor | None
    ) -> tuple[Tensor | None, Tensor | None, None, None, None]:
        x01, table = ctx.saved_tensors
        to_points, to_table = ctx.needs_input_grad[:2]
        # Gradients are enabled if the gradient itself will be differentiated.
        if torch.is_grad_enabled():
            return *_through_reference(ctx, x01, table, features, jacobian), None, None, None
        gradients = OutputGradients(features, jacobian)
        points, rows = x01.contiguous(), table.contiguous()
        return (
            ctx.kernels.point_gradient(points, rows, ctx.spec, gradients) if to_points else None,
            ctx.kernels.table_gradient(points, ctx.spec, gradients) if to_table else None,
            None,
            None,
            None,
        )


def _through_reference(
    ctx: FunctionCtx, x01: Tensor, table: Tensor, features: Tensor, jacobian: Tensor | None
) -> tuple[Tensor | None, Tensor | None]:
    """The same gradients by operations that autograd can differentiate again."""
    encoded = reference.encode(x01, table, ctx.spec, jacobian is not None)
    outputs = (encoded.features,) if jacobian is None else (encoded.features, encoded.jacobian)
    gradients = (features,) if jacobian is None else (features, jacobian)
    wanted = [tensor for tensor, needed in zip((x01, table), ctx.needs_input_grad[:2], strict=True) if needed]
    derivatives = iter(torch.autograd.grad(outputs, wanted, gradients, create_graph=True, allow_unused=True))
    to_points, to_table = (next(derivatives) if needed else None for needed in ctx.needs_input_grad[:2])
    return to_points, to_table
