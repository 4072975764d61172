"""The compiled loops, if Numba is there."""

from __future__ import annotations

import importlib
from functools import lru_cache
from types import ModuleType

import torch

__all__ = ["loops"]


@lru_cache(maxsize=1)
@torch.compiler.disable
def loops() -> ModuleType | None:
    """The module `kernels.compiled`, loaded at its first use; None without Numba."""
    try:
        return importlib.import_module("neilfpp_method.kernels.compiled")
    except ImportError:
        return None
