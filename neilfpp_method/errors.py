"""Exceptions that end a command with one line of text and an exit status, instead of a traceback."""

from __future__ import annotations

import unicodedata

__all__ = ["Diverged", "EarlyEnd", "Stopped", "Unsound", "UserError"]


LONGEST_HEAD, LONGEST_TAIL = 1200, 300
"""Characters kept of the beginning and the end of a long problem. The beginning has room for a path, the end
for the last line of a library's message.
"""


def _short(text: str) -> str:
    whole = len(text) <= LONGEST_HEAD + LONGEST_TAIL
    return text if whole else f"{text[:LONGEST_HEAD]} … {text[-LONGEST_TAIL:]}"


def _printable(text: str) -> str:
    """Escape control characters, line breaks and undecodable bytes.

    Names and contents of files may hold escape sequences that would act on a terminal.
    """
    unsafe = {char for char in text if unicodedata.category(char) in ("Cc", "Cf", "Cs", "Zl", "Zp")}
    return text.translate({ord(char): char.encode("unicode_escape").decode() for char in unsafe})


class EarlyEnd(Exception):
    """Base of errors that the command line prints as one line, "problem; remedy", and exits with `status`.

    Args:
        problem: what is wrong, and where.
        remedy: what to do about it.
    """

    status = 1

    def __init__(self, problem: str, remedy: str) -> None:
        problem, remedy = _printable(_short(problem)), _printable(remedy)
        super().__init__(f"{problem}; {remedy}")
        self.problem = problem
        self.remedy = remedy


class UserError(EarlyEnd):
    """Bad input that the user can correct."""

    status = 2


class Stopped(EarlyEnd):
    """The user stopped the command; what was computed is saved."""

    status = 130


class Diverged(EarlyEnd):
    """Training diverged: too many steps in a row had a loss or gradient that is not finite."""


class Unsound(EarlyEnd):
    """Training finished, but its result is unusable."""
