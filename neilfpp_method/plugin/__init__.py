"""The nerfstudio plugin: `ns-train neilfpp --data CAPTURE` and the other `ns-*` commands.

Every nerfstudio command loads the specifications below. They are created on access, and one that cannot be
created is reported and left out, so that a broken installation of this package does not affect other methods.
"""

from __future__ import annotations

import sys
from importlib import import_module
from typing import Any

_SPECIFICATIONS = {
    "neilfpp": "neilfpp_method.plugin.method",
    "neilfpp_mesh": "neilfpp_method.plugin.method",
    "neilfpp_data": "neilfpp_method.plugin.dataparser",
}


def __getattr__(name: str) -> Any:
    if name not in _SPECIFICATIONS:
        raise AttributeError(f"module 'neilfpp_method.plugin' has no attribute '{name}'")
    try:
        return getattr(import_module(_SPECIFICATIONS[name]), name)
    except Exception as error:
        # The import of a dependency can raise anything.
        print(f"neilfpp-method: {name} is not available in nerfstudio ({error!r})", file=sys.stderr)
        return None
