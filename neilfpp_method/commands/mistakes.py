"""A command line that cannot be read: what is wrong with it, in one line, and what was probably meant."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from difflib import get_close_matches
from itertools import pairwise

__all__ = ["closest", "mistake"]

TYRO_SUGGESTS = "Perhaps you meant"
TYRO_UNKNOWN = "Unrecognized options:"


def closest(word: str, known: Iterable[str]) -> str | None:
    """The known word that is most like a mistyped one; none: nothing is like it.

    >>> closest("tran", ["train", "render"])
    'train'
    """
    return next(iter(get_close_matches(word, list(known), n=1, cutoff=0.7)), None)


def mistake(complaint: str, arguments: Sequence[str]) -> tuple[str, str | None]:
    """What tyro's boxed complaint says first, and the option that was probably meant.

    Args:
        complaint: the box as tyro prints it; its paragraphs are separated by rules.
        arguments: the words of the command line.
    """
    lines = [
        line.strip("│ ") for line in complaint.splitlines() if line.startswith("│")
    ] or complaint.splitlines()
    paragraphs: list[list[str]] = [[]]
    for line in lines:
        if line.strip("─ "):
            paragraphs[-1].append(line)
        else:
            paragraphs.append([])
    what = " ".join(paragraphs[0]).rstrip(".")
    return what, _flag_with_a_value(what, arguments) or _suggested(what, paragraphs)


def _suggested(what: str, paragraphs: Sequence[Sequence[str]]) -> str | None:
    """The option that is most like the first unknown word, of those that tyro suggests under a heading."""
    unknown = what.removeprefix(TYRO_UNKNOWN).replace(",", " ").split()
    for heading, *suggestions in filter(None, paragraphs):
        if heading.startswith(TYRO_SUGGESTS):
            options = [line.split()[0].rstrip(",") for line in suggestions if line.startswith("--")]
            return next(iter(get_close_matches(unknown[0], options, n=1, cutoff=0.0)), None)
    return None


def _flag_with_a_value(what: str, arguments: Sequence[str]) -> str | None:
    """How to write `--a.flag False`, of which tyro says that it does not know the word False:
    `--a.no-flag`.
    """
    if not what.startswith(TYRO_UNKNOWN):
        return None
    unknown = what.removeprefix(TYRO_UNKNOWN).replace(",", " ").split()
    for option, word in pairwise(arguments):
        if word in unknown and option.startswith("--") and option not in unknown:
            if word.lower() == "true":
                return option
            if word.lower() == "false":
                room, dot, flag = option.removeprefix("--").rpartition(".")
                return f"--{room}{dot}no-{flag}"
    return None
