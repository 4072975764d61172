"""What has kernels of its own: hash-grid encoding, rays through a distance grid, softplus units.

Every backend of the encoding computes what `reference.encode` computes, which the tests hold it to.
`GridSpec.backend` names one; "auto" takes the compiled loops on a CPU, Triton's kernels on a GPU, and the
reference anywhere else.
"""

from __future__ import annotations

import importlib
import warnings
from collections.abc import Callable, Mapping
from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.errors import UserError
from neilfpp_method.kernels import reference
from neilfpp_method.kernels.function import Kernels, encode_with, fits
from neilfpp_method.kernels.grid import Encoded, GridSpec, grid_spec

__all__ = ["Encoded", "GridSpec", "encode", "grid_spec", "ray_tracer"]

FASTEST: Mapping[str, str] = {"cpu": "cpu", "cuda": "triton"}
"""The backend of each kind of device; the reference runs on those that are not named."""


def encode(x01: Float[Tensor, "N 3"], table: Float[Tensor, "T F"], spec: GridSpec, jacobian: bool) -> Encoded:
    """Features of a multiresolution grid at points of the unit cube, by the backend that `spec` names.

    Args:
        x01: points; outside [0, 1]³ the nearest point of the cube counts, and the derivative across its face
            is 0.
        table: `spec.entries` rows of `spec.features`.
        spec: the layout of the table.
        jacobian: whether to return d features / d x01 as well.

    Returns:
        `spec.width` features per point, in the dtype of the table. Features and Jacobian can be
        differentiated with respect to the table and the points, any number of times: the reference does what
        goes beyond the first order, and types other than float32 and float64. The memory order of what is
        returned is the backend's own.

    Raises:
        UserError: the backend that `spec` names does not run here.
    """
    kernels = _kernels(spec.backend, x01.device.type)
    if kernels is None or not fits(x01, table):
        return reference.encode(x01, table, spec, jacobian)
    return encode_with(kernels, x01, table, spec, jacobian)


@lru_cache(maxsize=8)
@torch.compiler.disable  # nor into what imports them
def _kernels(backend: str, device: str) -> Kernels | None:
    """The kernels of a backend, loaded when first asked for; none: the reference."""
    name = FASTEST.get(device, "reference") if backend == "auto" else backend
    if name == "reference":
        return None
    try:
        module = importlib.import_module(f"neilfpp_method.kernels.{name}")
    except ImportError as error:
        if backend != "auto":
            raise UserError(
                f"hash-grid backend '{name}': {error}", "install what is missing, or set it to auto"
            ) from error
        warnings.warn(f"hash grids take the slow reference: {error}", RuntimeWarning, stacklevel=3)
        return None
    if device not in module.KERNELS.devices:
        raise UserError(
            f"hash-grid backend '{name}' does not run on {device}",
            "set the backend of its `GridSpec` to auto",
        )
    return module.KERNELS


@lru_cache(maxsize=8)
@torch.compiler.disable
def ray_tracer(device: str) -> Callable[..., None] | None:
    """`tracing.sphere_trace`, where it runs on a device of this kind."""
    if device != "cpu":
        return None
    try:
        return importlib.import_module("neilfpp_method.kernels.tracing").sphere_trace
    except ImportError as error:
        warnings.warn(f"rays are traced by the slow reference: {error}", RuntimeWarning, stacklevel=3)
        return None
