"""How a command ends early: what is wrong or was asked, where, and what to do about it, in one line."""

from __future__ import annotations

import unicodedata

__all__ = ["Diverged", "EarlyEnd", "Stopped", "Unsound", "UserError"]


LONGEST_HEAD, LONGEST_TAIL = 1200, 300
"""Characters of a problem that are shown: a path, and what a library says of the file."""


def _short(text: str) -> str:
    whole = len(text) <= LONGEST_HEAD + LONGEST_TAIL
    return text if whole else f"{text[:LONGEST_HEAD]} … {text[-LONGEST_TAIL:]}"


def _printable(text: str) -> str:
    """One line that does nothing to a terminal, whatever a file says or is called: control characters, and
    bytes that are no text, are written as escapes.
    """
    hidden = {sign for sign in text if unicodedata.category(sign) in ("Cc", "Cf", "Cs", "Zl", "Zp")}
    return text.translate({ord(sign): sign.encode("unicode_escape").decode() for sign in hidden})


class EarlyEnd(Exception):
    """The command line prints the problem and the remedy as one line and exits with `status`."""

    status = 1

    def __init__(self, problem: str, remedy: str) -> None:
        problem, remedy = _printable(_short(problem)), _printable(remedy)
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
