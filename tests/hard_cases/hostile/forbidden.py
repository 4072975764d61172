"""What no reader may do: open files elsewhere, start programs, use the network, or load what a file names."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path

__all__ = ["watch"]

REPOSITORY = Path(__file__).parents[3]
OF_THE_PROCESS = tuple(
    os.path.realpath(folder) + os.sep for folder in (REPOSITORY, sys.prefix, sys.base_prefix, "/proc", "/sys")
)
"""Python's modules, and what the system says about the process."""

TAKE_PATHS = {
    **dict.fromkeys(("open", "os.remove", "os.rmdir", "os.chmod"), 1),
    **dict.fromkeys(("os.rename", "os.link", "os.symlink"), 2),
}
"""Events of `sys.addaudithook` whose first arguments are paths, and their number."""
FORBIDDEN = {
    *("os.system", "os.exec", "os.posix_spawn", "os.spawn", "os.fork", "subprocess.Popen", "pty.spawn"),
    *("socket.connect", "socket.bind", "socket.getaddrinfo", "urllib.Request", "ctypes.dlopen"),
    "pickle.find_class",
}
"""Events that may not occur at all. Native libraries report none, but they open only what Python code names.
"""


def watch(folder: Path) -> Callable[[], list[str]]:
    """Watch this process until it ends, and return a function that lists what was forbidden since its last
    call.

    Args:
        folder: files in it may be read and written.
    """
    inside, found = os.path.realpath(folder) + os.sep, []

    def hook(event: str, arguments: tuple) -> None:
        for path in arguments[: TAKE_PATHS.get(event, 0)]:
            if isinstance(path, (str, bytes)):  # not the number of an open file
                path = os.path.realpath(os.fsdecode(path))
                if not path.startswith((inside, *OF_THE_PROCESS)) and path != os.devnull:
                    found.append(f"{event} {path}")
        if event in FORBIDDEN:
            found.append(f"{event} {str(arguments)[:200]}")

    def since() -> list[str]:
        events = found[:]
        found.clear()
        return events

    sys.addaudithook(hook)
    return since
