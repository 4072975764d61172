"""Each command that a document quotes is one that the parser takes, and each link leads somewhere."""

from __future__ import annotations

import importlib
import re
import shlex
import subprocess
from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from functools import wraps
from io import StringIO
from pathlib import Path

import pytest
import tyro

from benchmarks.__main__ import SUITES
from neilfpp_method.cli import main
from neilfpp_method.commands import COMMANDS

ROOT = Path(__file__).parent.parent
DOCUMENTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
NOTEBOOK = sorted((ROOT / "docs" / "notebook").glob("*.md"))
STARTS = ("neilfpp ", "python -m benchmarks", "make ")
CHEAP = {
    "neilfpp --help",
    "neilfpp --version",
    "neilfpp train --help",
    "neilfpp completion bash",
    "neilfpp completion zsh",
}


def quoted(text: str) -> Iterator[str]:
    """The commands of a Markdown text: lines of fenced and indented blocks (`\\` continues one), and in
    backticks.
    """
    inline = []
    fenced = False
    block: list[str] = []
    for line in text.splitlines():
        if line.startswith("```"):
            fenced = not fenced
        elif fenced or line.startswith("    "):
            block.append(line.strip())
        else:
            inline.append(line)
    lines = "\n".join(block).replace("\\\n", " ").splitlines()
    spans = re.findall(r"`([^`]+)`", " ".join(inline))
    for words in (*lines, *spans):
        if words.startswith(STARTS) and "…" not in words:
            yield " ".join(words.split())


COMMAND_LINES = sorted({(path.name, line) for path in DOCUMENTS for line in quoted(path.read_text("utf-8"))})


def words_of(line: str) -> list[str]:
    """The words of a command line, without comments and where its output goes. N stands for a number."""
    words = ["2" if word == "N" else word for word in shlex.split(line, comments=True)]
    return words[: words.index(">")] if ">" in words else words


def refusal(line: str) -> str:
    """What is wrong with a command line; empty: nothing. No command is run."""
    words = words_of(line)
    if words[0] == "neilfpp":
        return _refused_by_the_cli(words[1:])
    if words[0] == "make":
        targets = [word for word in words[1:] if "=" not in word]
        dry = subprocess.run(
            ["make", "--dry-run", *targets], cwd=ROOT, capture_output=True, text=True, check=False
        )
        return dry.stderr
    return _refused_by_a_benchmark(words[2], words[3:])


def _refused_by_the_cli(arguments: list[str]) -> str:
    if len(arguments) == 1 or arguments[1:] == ["--help"]:  # a command by its name
        return "" if arguments[0] in ("--help", "--version", *COMMANDS) else f"no command {arguments[0]}"
    complaint = StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stderr(complaint):
        for name, command in COMMANDS.items():
            patch.setitem(COMMANDS, name, replace(command, run=lambda options: None))
        with redirect_stdout(StringIO()):
            status = main(arguments)
    return complaint.getvalue() if status else ""


def _refused_by_a_benchmark(module: str, arguments: list[str]) -> str:
    if module == "benchmarks":
        unknown = {word for word in arguments if not word.startswith("-")} - SUITES.keys()
        if unknown:
            return f"no suite {unknown}"
    try:
        found = importlib.import_module(module)
        if hasattr(found, "__path__"):
            found = importlib.import_module(f"{module}.__main__")
    except ModuleNotFoundError as error:
        return str(error)
    if not arguments:
        return "" if hasattr(found, "main") else f"{module} is no command"
    options = getattr(found, "Options", None) or wraps(found.main)(lambda *_, **__: None)
    complaint = StringIO()
    try:
        with redirect_stderr(complaint), redirect_stdout(complaint):
            tyro.cli(options, args=arguments)
    except SystemExit:
        return complaint.getvalue()
    return ""


def test_commands_are_found():
    assert len([line for _, line in COMMAND_LINES if line.startswith("neilfpp ")]) > 20
    assert {"README.md", "CONTRIBUTING.md", "results.md", "light.md"} <= {name for name, _ in COMMAND_LINES}


@pytest.mark.parametrize(("document", "line"), COMMAND_LINES)
def test_a_quoted_command_is_a_command(document, line):
    assert refusal(line) == "", f"{document}: {line}"


@pytest.mark.parametrize("line", sorted(CHEAP & {line for _, line in COMMAND_LINES} | {"neilfpp --help"}))
def test_a_cheap_command_runs(line):
    printed = StringIO()
    with redirect_stdout(printed):
        assert main(words_of(line)[1:]) == 0
    assert "neilfpp" in printed.getvalue()


@pytest.mark.parametrize(
    "line",
    [
        "neilfpp paint runs/teapot",
        "neilfpp train --data DIR --config.shading.specular False",
        "neilfpp export RUN --what shadow",
        "make tea",
        "python -m benchmarks tea",
        "python -m benchmarks.tea",
        "python -m benchmarks.growth --tea",
    ],
)
def test_what_is_no_command_is_refused(line):
    assert refusal(line)


def test_commands_are_quoted_in_three_ways():
    text = "Run `neilfpp\neval RUN`:\n\n    make demo\n\n"
    text += "```sh\nneilfpp train --data A \\\n    --out B   # why\nls\n```\n"
    assert list(quoted(text)) == ["make demo", "neilfpp train --data A --out B # why", "neilfpp eval RUN"]
    assert words_of("neilfpp completion bash > FILE  # once") == ["neilfpp", "completion", "bash"]


@pytest.mark.parametrize("path", [*DOCUMENTS, *NOTEBOOK], ids=lambda path: path.name)
def test_links_lead_somewhere(path):
    for target in re.findall(r"\]\(([^)\s]+)\)", path.read_text("utf-8")):
        if not target.startswith(("https://", "http://", "#")):
            assert (path.parent / target.partition("#")[0]).exists(), target


@pytest.mark.parametrize("name", ["results.md", "performance.md"])
def test_pages_of_figures_are_short(name):
    assert len((ROOT / "docs" / name).read_text("utf-8").split()) <= 1500
