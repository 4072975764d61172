"""Kernels for hash-grid encoding, sphere tracing in a distance grid, and softplus units.

Every backend of the encoding computes the same as `reference.encode`, which the tests check. The backend is
chosen by `GridSpec.backend`; "auto" selects the compiled loops on a CPU, the Triton kernels on a GPU, and the
reference on other devices.
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
"""The fastest backend of each kind of device; on others it is the reference."""


def encode(x01: Float[Tensor, "N 3"], table: Float[Tensor, "T F"], spec: GridSpec, jacobian: bool) -> Encoded:
    """Encode points of the unit cube by a multiresolution grid, with the backend that `spec` names.

    Args:
        x01: points; those outside of [0, 1]³ are clamped to it, and the derivative across its faces is 0.
        table: `spec.entries` rows of `spec.features` numbers.
        spec: the layout of the table.
        jacobian: whether to return d features / d x01 as well.

    Returns:
        `spec.width` features per point, in the dtype of the table. Features and Jacobian can be
        differentiated any number of times with respect to the table and the points. Orders beyond the first,
        and types other than float32 and float64, are computed by the reference. The memory order of the
        result depends on the backend.

    Raises:
        UserError: if the backend that `spec` names does not run on this device.
    """
    kernels = _kernels(spec.backend, x01.device.type)
    if kernels is None or not fits(x01, table):
        return reference.encode(x01, table, spec, jacobian)
    return encode_with(kernels, x01, table, spec, jacobian)


# `torch.compile` must not trace the imports.
@lru_cache(maxsize=8)
@torch.compiler.disable
def _kernels(backend: str, device: str) -> Kernels | None:
    """The kernels of a backend, loaded at their first use; None for the reference."""
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
        warnings.warn(f"hash grids use the slow reference backend: {error}", RuntimeWarning, stacklevel=3)
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
    """`tracing.sphere_trace` if it runs on this kind of device, otherwise None."""
    if device != "cpu":
        return None
    try:
        return importlib.import_module("neilfpp_method.kernels.tracing").sphere_trace
    except ImportError as error:
        warnings.warn(f"rays are traced by the slow reference code: {error}", RuntimeWarning, stacklevel=3)
        return None
