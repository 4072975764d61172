"""NeILF++ for any host: geometry, material and light from posed images.

Public names import their modules on first access, so that `import neilfpp_method` is fast.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

__version__ = "0.1.0"
__all__ = ["NeilfConfig", "NeilfModel", "__version__", "attach_neilf", "load_run", "preset"]

_MODULES = {
    "NeilfConfig": "neilfpp_method.settings.types",
    "NeilfModel": "neilfpp_method.model",
    "attach_neilf": "neilfpp_method.attach",
    "load_run": "neilfpp_method.train.run",
    "preset": "neilfpp_method.settings.presets",
}


def __dir__() -> list[str]:
    """The public names, which become attributes only on first access."""
    return sorted(__all__)


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module 'neilfpp_method' has no attribute '{name}'")
    return getattr(import_module(_MODULES[name]), name)
