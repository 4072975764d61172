"""The device to compute on."""

from __future__ import annotations

import re
from collections.abc import Callable

import torch

from neilfpp_method.errors import UserError

__all__ = ["pick_device", "waiting"]


def pick_device(name: str) -> torch.device:
    """The device with this name; "auto" selects a GPU if there is one and the CPU otherwise.

    Raises:
        UserError: if this machine has no such device.
    """
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        if not re.fullmatch(r"cpu|cuda(:\d+)?", name):
            raise RuntimeError("neither a CPU nor a CUDA device")
        torch.empty(0, device=name)
    except (RuntimeError, AssertionError) as error:
        raise UserError(f"no device '{name}' here", "use cpu, cuda, cuda:N or auto") from error
    return torch.device(name)


def waiting(device: torch.device) -> Callable[[], object] | None:
    """A function that waits until a device has finished its work; None if calls are synchronous."""
    return (lambda: torch.cuda.synchronize(device)) if device.type == "cuda" else None
