"""Read files of `torch.save` that may come from unknown sources: checkpoints and skipped steps."""

from __future__ import annotations

import pickletools
import re
import warnings
import zipfile
from pathlib import Path
from typing import Any

import torch

__all__ = ["read_tensor_file"]

NAMES = re.compile(
    r"collections OrderedDict|torch\._utils _rebuild_(tensor_v2|parameter)|torch (?!Untyped|Typed)\w+Storage"
)
"""Names to which the pickle of tensors and plain values refers, as "module name"."""


def read_tensor_file(path: Path) -> Any:
    """Read tensors and plain values onto the CPU.

    A forged file runs no code and takes no more memory than its size. `torch.load` alone would unpack
    compressed members, and would make byte arrays of any length that the file asks for.

    Raises:
        Exception: of any type, if the file is damaged or forged.
    """
    with zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        if any(member.compress_type != zipfile.ZIP_STORED for member in members):
            raise ValueError("compressed, which torch.save does not do")
        if sum(member.file_size for member in members) > path.stat().st_size:
            raise ValueError("its members are larger than the file")
        for member in members:
            if member.filename.endswith(".pkl"):
                _check_names(archive.read(member))
    with warnings.catch_warnings():
        # If torch cannot read another protocol, it also raises an error, which is all that a user needs.
        warnings.filterwarnings("ignore", "Detected pickle protocol")
        return torch.load(path, map_location="cpu", weights_only=True)


def _check_names(pickle: bytes) -> None:
    for opcode, argument, _ in pickletools.genops(pickle):
        if opcode.name == "GLOBAL" and not NAMES.fullmatch(argument):
            raise ValueError(f"it refers to {argument}")
