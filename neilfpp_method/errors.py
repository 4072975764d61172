"""How a command ends early: what is wrong or was asked, where, and what to do about it, in one line."""

from __future__ import annotations

__all__ = ["Diverged", "EarlyEnd", "Stopped", "Unsound", "UserError"]


class EarlyEnd(Exception):
    """The command line prints the problem and the remedy as one line and exits with `status`."""

    status = 1

    def __init__(self, problem: str, remedy: str) -> None:
        super().__init__(f"{problem}; {remedy}")
        self.problem = problem
        self.remedy = remedy


class UserError(EarlyEnd):
    """Bad input that a person can mend."""

    status = 2


class Stopped(EarlyEnd):
    """A person asked to stop; nothing is lost."""

    status = 130


class Diverged(EarlyEnd):
    """Training met too many steps in a row without a finite loss and gradient."""


class Unsound(EarlyEnd):
    """Training came to its end, and its result is of no use."""
