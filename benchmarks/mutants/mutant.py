"""A fault that is planted in the package."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["Mutant"]


@dataclass(frozen=True)
class Mutant:
    """A fault in a module of the package.

    Attributes:
        what: the fault in a few words.
        module: path of the module below the package.
        old: the code that the fault replaces; it occurs exactly once in the module.
        new: the code with the fault.
        tests: path below `tests` of the tests that should notice it.
    """

    what: str
    module: str
    old: str
    new: str
    tests: str
