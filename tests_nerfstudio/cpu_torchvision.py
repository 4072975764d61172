"""Torchvision beside a CPU build of torch. Nothing of this is needed if both are builds of the same kind.

The wheels of torchvision are CUDA builds. Beside a CPU build of torch their compiled library cannot be
loaded. Two operators then have no schema, and `import torchvision` fails, so they are declared before it.
`make test-nerfstudio` has every Python of its environment import this module, so that the `ns-*` commands
start there by hand, too. The module imports torch only when torchvision is imported.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from types import ModuleType

OPERATORS = ("nms", "qnms")


class DeclaringFinder(MetaPathFinder):
    """Finds no module, but declares the missing operators before torchvision is first imported."""

    def __init__(self) -> None:
        # The operators exist as long as this object.
        self.declared: object = None

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Leave the search to the other finders."""
        if fullname == "torchvision" and self.declared is None:
            self.declared = _declare_missing()
        return None


def _declare_missing() -> object:
    """Declare the operators unless torchvision's own library can be loaded; returns what keeps them."""
    found = PathFinder.find_spec("torchvision")
    if found is None or found.origin is None:
        return None
    import torch

    try:
        torch.ops.load_library(str(next(Path(found.origin).parent.glob("_C*.so"))))
    except (OSError, StopIteration):
        library = torch.library.Library("torchvision", "DEF")
        for name in OPERATORS:
            library.define(f"{name}(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
        return library
    return True


sys.meta_path.insert(0, DeclaringFinder())
