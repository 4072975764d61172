"""Check shapes in only some calls: the first ones of each function in a test, and every 16th later one.

On small tensors a check takes as long as the function itself. Loops repeat the shapes of their first rounds.
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
"""The first calls of a function in each test are all checked, up to this number."""
EVERY = 16
"""A later call is checked if its number is a multiple of this."""

_calls: Counter[CodeType] = Counter()
"""Number of calls in the current test. Closures that one function creates share their code, and are counted
together.
"""
_checked = jaxtyping.jaxtyped


def start_test() -> None:
    """Set all numbers of calls to 0."""
    _calls.clear()


def check_some_calls() -> None:
    """Make the import hook of jaxtyping use `jaxtyped`. Modules imported before this check every call."""
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
    # To wrap a closure in a check takes longer than most closures run, so this waits for its first checked
    # call. Other functions are wrapped now: a test may later replace a class that an annotation names.
    checked = functools.cache(functools.partial(_checked, function, typechecker=typechecker))
    if "<locals>" not in function.__qualname__:
        checked()

    @functools.wraps(function)
    def call(*args, **kwargs):
        _calls[code] += 1
        is_checked = _calls[code] <= FIRST or _calls[code] % EVERY == 0
        return (checked() if is_checked else function)(*args, **kwargs)

    return call
