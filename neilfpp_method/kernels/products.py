"""Products of a large matrix with three columns, one per colour channel, and the gradients of such products.

A light fit consists of them: a transport matrix times the radiance of the sources. Matrix libraries are made
for wide factors, and take several times as long as reading the matrix once.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import FunctionCtx
from torch.nn import functional

from neilfpp_method.kernels.loops import loops
from neilfpp_method.kernels.threads import for_each, shares

__all__ = ["times_channels"]

MIN_ROWS_PER_THREAD = 1024
"""Minimum work of a thread, in rows; below it, starting the thread costs more than it saves."""


def times_channels(matrix: Float[Tensor, "*R T"], channels: Float[Tensor, "T 3"]) -> Float[Tensor, "*R 3"]:
    """matrix @ channels, differentiable once with respect to both.

    Example:
        >>> times_channels(torch.eye(2), torch.tensor([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])).tolist()
        [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]
    """
    return _TimesChannels.apply(matrix, channels)


class _TimesChannels(torch.autograd.Function):
    @staticmethod
    def forward(ctx: FunctionCtx, matrix: Tensor, channels: Tensor) -> Tensor:
        ctx.save_for_backward(matrix, channels)
        # `linear` is three to five times faster than `@` for so few columns.
        return functional.linear(matrix, channels.t().contiguous())

    @staticmethod
    def backward(ctx: FunctionCtx, grad: Tensor) -> tuple[Tensor | None, Tensor | None]:
        matrix, channels = ctx.saved_tensors
        to_matrix = grad @ channels.t() if ctx.needs_input_grad[0] else None
        to_channels = None
        if ctx.needs_input_grad[1]:
            to_channels = _transposed_product(matrix.flatten(0, -2), grad.flatten(0, -2))
        return to_matrix, to_channels


# `torch.compile` cannot trace the loops.
@torch.compiler.disable
def _transposed_product(matrix: Float[Tensor, "R T"], weights: Float[Tensor, "R 3"]) -> Float[Tensor, "T 3"]:
    """matrix.T @ weights, reading the matrix once, row by row."""
    takes = matrix.device.type == "cpu" and matrix.dtype in (torch.float32, torch.float64)
    if not takes or loops() is None:
        return (weights.t() @ matrix).t()
    rows, factors = matrix.detach().contiguous().numpy(), weights.detach().contiguous().numpy()
    ranges = shares(len(rows), MIN_ROWS_PER_THREAD)
    sums = matrix.new_zeros(len(ranges), 3, matrix.shape[1])
    # One sum per thread, and all of them in a fixed order: the result depends only on the number of threads.
    of_range = dict(zip(ranges, sums.numpy(), strict=True))
    for_each(
        lambda start, stop: loops().add_weighted_rows(rows, factors, of_range[start, stop], start, stop),
        ranges,
    )
    return sums.sum(0).t()
