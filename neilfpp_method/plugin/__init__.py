"""The method inside nerfstudio: `ns-train neilfpp --data CAPTURE`, and every `ns-*` command that follows it.

Nerfstudio loads the specifications below in every command that it has. They are made when it asks for them,
and one that cannot be made is reported and left out: a broken installation of this package costs its own
methods, no others.
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
    except Exception as error:  # whatever a dependency may raise
        print(f"neilfpp-method: {name} is not available in nerfstudio ({error!r})", file=sys.stderr)
        return None
