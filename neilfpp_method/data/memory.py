"""Free memory, and an error before a process allocates more and is killed without a message."""

from __future__ import annotations

import resource
from pathlib import Path

from neilfpp_method.errors import UserError

__all__ = ["available_memory", "check_memory"]

UNLIMITED = 2**60
"""Limit of a version 1 control group, in bytes, above which it means that there is no limit."""


def available_memory(proc: Path = Path("/proc"), groups: Path = Path("/sys/fs/cgroup")) -> int | None:
    """Return the number of bytes that this process may still allocate.

    This is the minimum over the free memory of the system, the limits of its control group (both versions,
    and all groups above it), and its limit of address space. Cached file pages that the system can evict
    count as free.

    Returns:
        Bytes; None if none of these is known.
    """
    limits = [_system(proc), _group(proc, groups), _group_1(groups), _address_space(proc)]
    return min((free for free in limits if free is not None), default=None)


def check_memory(needed: int, what: str, remedy: str, free: int | None = None) -> None:
    """Check that there is enough memory; passes if the free memory is unknown.

    Args:
        needed: number of bytes.
        what: what needs them, in the plural, for the message: "the pixels of 40 views".
        free: number of free bytes; if None, `available_memory`.

    Raises:
        UserError: there is not enough memory.
    """
    free = available_memory() if free is None else free
    if free is not None and needed > free:
        raise UserError(
            f"{what} need about {needed / 1e9:.1f} GB of memory, and {max(free, 0) / 1e9:.1f} GB are free",
            remedy,
        )


def _system(proc: Path) -> int | None:
    return _entry(proc / "meminfo", "MemAvailable:", 1024)


def _group(proc: Path, groups: Path) -> int | None:
    """Free bytes by control groups, version 2; the limits of all groups above apply as well."""
    path = next(
        (line[3:].strip("/") for line in _lines(proc / "self" / "cgroup") if line.startswith("0::")), ""
    )
    folder, free = groups / path, []
    while folder.is_relative_to(groups):
        limit, used = _number(folder / "memory.max"), _number(folder / "memory.current")
        if limit is not None and used is not None:
            free.append(limit - used + (_entry(folder / "memory.stat", "inactive_file", 1) or 0))
        folder = folder.parent
    return min(free, default=None)


def _group_1(groups: Path) -> int | None:
    """Free bytes by control groups, version 1, as a container sees its own group."""
    folder = groups / "memory"
    limit, used = _number(folder / "memory.limit_in_bytes"), _number(folder / "memory.usage_in_bytes")
    if limit is None or used is None or limit > UNLIMITED:
        return None
    return limit - used + (_entry(folder / "memory.stat", "total_inactive_file", 1) or 0)


def _address_space(proc: Path) -> int | None:
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    used = _entry(proc / "self" / "status", "VmSize:", 1024)
    return None if limit == resource.RLIM_INFINITY or used is None else limit - used


def _number(path: Path) -> int | None:
    """The number in a file; None if the file contains "max" or does not exist."""
    text = "".join(_lines(path)[:1]).strip()
    return int(text) if text.isdigit() else None


def _entry(path: Path, name: str, unit: int) -> int | None:
    """The number in the line "NAME NUMBER" of a file, times the unit."""
    found = [line.split()[1] for line in _lines(path) if line.split()[:1] == [name]]
    return int(found[0]) * unit if found else None


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text("ascii", "replace").splitlines()
    except OSError:
        return []
