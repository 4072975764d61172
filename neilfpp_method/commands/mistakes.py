"""Turn tyro's description of a faulty command line into one line, with a suggestion."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from itertools import pairwise

__all__ = ["TYRO_UNKNOWN", "Mistake", "closest", "mistake"]

TYRO_SUGGESTS = "Perhaps you meant"
"""Heading of the options that tyro suggests."""
TYRO_MISSING = "Missing from"
"""Beginning of tyro's message about options that are required; their names and descriptions follow."""
NAME = re.compile("│     [^ ].*")
"""A line of that message with the name of an option; descriptions are indented further."""
UNPARSED = re.compile(
    r"Error parsing (?P<option>\S+): "
    r"(?:no type matching (?P<wanted>.+) could be instantiated from \[(?P<list>.*)\]"
    r"|invalid literal for int\(\) with base 10: (?P<whole>.*)"
    r"|could not convert string to float: (?P<real>.*))"
)
"""Tyro's messages about values that are not numbers."""
NUMBERS = {"INT": "a whole number", "FLOAT": "a number"}
"""Tyro's names of the types of single numbers, and what they are called in messages."""
TYRO_UNKNOWN = "Unrecognized options:"
"""Beginning of tyro's message about unknown options."""


def closest(word: str, words: Iterable[str]) -> str | None:
    """The known word that is most similar to a mistyped one; None if none is similar.

    >>> closest("tran", ["train", "render"])
    'train'
    """
    return next(iter(get_close_matches(word, list(words), n=1, cutoff=0.7)), None)


@dataclass(frozen=True)
class Mistake:
    """What is wrong with a command line, and the option that was probably meant; None if there is none."""

    what: str
    meant: str | None


def mistake(complaint: str, arguments: Sequence[str]) -> Mistake:
    """Find the mistake that tyro's error output describes.

    Args:
        complaint: the box that tyro prints; its paragraphs are separated by rules.
        arguments: the words of the command line.
    """
    if "│" not in complaint:
        complaint = _boxed(complaint) or complaint
    boxed = [line.strip("│ ") for line in complaint.splitlines() if line.startswith("│")]
    lines = boxed or complaint.splitlines()
    paragraphs: list[list[str]] = [[]]
    for line in lines:
        if line.strip("─ "):
            paragraphs[-1].append(line)
        else:
            paragraphs.append([])
    what = " ".join(paragraphs[0]).rstrip(".")
    if unparsed := UNPARSED.fullmatch(what):
        return Mistake(_unparsed(unparsed), None)
    if what.startswith(TYRO_MISSING):
        return Mistake(_missing(complaint) or what, None)
    return Mistake(what, _flag_with_a_value(what, arguments) or _suggested(what, paragraphs))


def _boxed(complaint: str) -> str:
    """The same with the signs of a box, which tyro leaves out if standard output is not UTF-8.

    Its title and a rule come first, and rules are of hyphens.
    """
    body = complaint.splitlines()[2:]
    return "\n".join("│" + (line.replace("-", "─") if not line.strip("- ") else line)[1:] for line in body)


def _unparsed(found: re.Match[str]) -> str:
    """What was given, and what is wanted.

    >>> _unparsed(UNPARSED.fullmatch("Error parsing --views: invalid literal for int() with base 10: 'all'"))
    "--views: 'all' is not a whole number"
    """
    given = found["whole"] or found["real"]
    if given:
        return f"{found['option']}: {given} is not {NUMBERS['INT' if found['whole'] else 'FLOAT']}"
    kinds = found["wanted"].removeprefix("{None}|").strip("{}").split()
    wanted = NUMBERS.get(kinds[0], kinds[0]) if len(kinds) == 1 else f"{len(kinds)} numbers"
    return f"{found['option']}: {found['list'].replace(',', '')} is not {wanted}"


def _missing(complaint: str) -> str:
    """The missing options, each with the first sentence of its description; empty if there is none."""
    parts: list[list[str]] = []
    for line in complaint.splitlines():
        if line.startswith("│ ─"):
            break
        text = line.strip("│ ")
        if NAME.match(line):
            parts.append([text])
        elif parts:
            parts[-1].append(text)
    described = (
        f"{name} ({' '.join(text).removesuffix('(required)').split('. ')[0].rstrip('. ')})"
        for name, *text in parts
    )
    return f"missing: {', '.join(described)}" if parts else ""


def _suggested(what: str, paragraphs: Sequence[Sequence[str]]) -> str | None:
    """The one of tyro's suggestions that is most similar to the first unknown word."""
    unknown = what.removeprefix(TYRO_UNKNOWN).replace(",", " ").split()
    for heading, *suggestions in filter(None, paragraphs):
        if heading.startswith(TYRO_SUGGESTS):
            options = [line.split()[0].rstrip(",") for line in suggestions if line.startswith("--")]
            return next(iter(get_close_matches(unknown[0], options, n=1, cutoff=0.0)), None)
    return None


def _flag_with_a_value(what: str, arguments: Sequence[str]) -> str | None:
    """The correct form `--a.no-flag` of `--a.flag False`, which tyro reports as an unknown word."""
    if not what.startswith(TYRO_UNKNOWN):
        return None
    unknown = what.removeprefix(TYRO_UNKNOWN).replace(",", " ").split()
    for option, word in pairwise(arguments):
        if word in unknown and option.startswith("--") and option not in unknown:
            if word.lower() == "true":
                return option
            if word.lower() == "false":
                part, dot, flag = option.removeprefix("--").rpartition(".")
                return f"--{part}{dot}no-{flag}"
    return None
