"""Check the shapes of the first calls of every function in each test, and of a share of its later calls.

On small tensors a check takes as long as the function itself, and loops repeat the shapes of their first
rounds.
"""

from __future__ import annotations

import dataclasses
import functools
from collections import Counter
from collections.abc import Callable
from types import CodeType
from typing import TypeVar

import jaxtyping

Function = TypeVar("Function", bound=Callable)

FIRST = 32
"""Number of calls of a function that are checked in every test."""
EVERY = 16
"""Of the later calls, every so many is checked."""

_calls: Counter[CodeType] = Counter()
"""How often each function was called in the current test. The closures of one function have one code."""
_checked = jaxtyping.jaxtyped


def start_test() -> None:
    """Begin again to count calls."""
    _calls.clear()


def check_some_calls() -> None:
    """Make the import hook of jaxtyping use `jaxtyped`. Modules imported before check every call."""
    jaxtyping.jaxtyped = jaxtyped


def jaxtyped(*, typechecker: Callable) -> Callable[[Function], Function]:
    """`jaxtyping.jaxtyped` for some calls of functions and of the constructors of dataclasses."""
    return functools.partial(_check_some, typechecker=typechecker)


def _check_some(function: Function, typechecker: Callable) -> Function:
    if isinstance(function, type):
        if dataclasses.is_dataclass(function) and "__init__" in vars(function):
            function.__init__ = _check_some(function.__init__, typechecker)
        return function
    code = function.__code__
    # That of a closure is made only if it is needed: it takes longer than most closures. Others are made now,
    # before a test replaces a class that an annotation names.
    checked = functools.cache(functools.partial(_checked, function, typechecker=typechecker))
    if "<locals>" not in function.__qualname__:
        checked()

    @functools.wraps(function)
    def call(*args, **kwargs):
        _calls[code] += 1
        is_checked = _calls[code] <= FIRST or _calls[code] % EVERY == 0
        return (checked() if is_checked else function)(*args, **kwargs)

    return call
