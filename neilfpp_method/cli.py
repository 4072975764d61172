"""The entry point of the command line, `neilfpp COMMAND …`; the commands are defined in `commands`."""

from __future__ import annotations

import dataclasses
import io
import os
import sys
from collections.abc import Sequence
from contextlib import redirect_stderr
from pathlib import Path
from typing import Any

import tyro
from rich.console import Console

from neilfpp_method.commands import COMMANDS
from neilfpp_method.commands.command import Command
from neilfpp_method.commands.ending import CLOSED_OUTPUT, ended_by_signal, forget_interrupt, output_is_closed
from neilfpp_method.commands.mistakes import TYRO_UNKNOWN, closest, mistake
from neilfpp_method.data.native_signals import signals_delayed
from neilfpp_method.errors import EarlyEnd, Stopped, UserError

__all__ = ["main"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command.

    Args:
        arguments: the words of the command line; None for those of the process.

    Returns:
        The exit status: 0 for success, 2 for bad input, 130 after Ctrl-C and for a stopped command that can
        be continued, 141 if standard output was closed, 143 after SIGTERM, 1 otherwise.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            # Names and signs that the encoding of the output lacks are printed as "?".
            stream.reconfigure(errors="replace")
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    if arguments[:1] == ["help"]:
        arguments = [*arguments[1:2], "--help"]
    if not arguments or arguments[0] in ("-h", "--help"):
        print(_overview())
        return 0
    # In a parallel training only the first process prints errors and sets the exit status.
    first = os.environ.get("LOCAL_RANK", "0") == "0"
    errors = Console(stderr=True, quiet=not first)
    with ended_by_signal() as ending:
        try:
            with ending.raised():
                _run(arguments[0], arguments[1:])
        except EarlyEnd as end:
            if isinstance(end.__cause__, BrokenPipeError) and output_is_closed():
                return CLOSED_OUTPUT
            text = str(end) if isinstance(end, Stopped) else f"error: {end}"
            errors.print(text, highlight=False, soft_wrap=True, markup=False)
            return end.status if first else 0
        except SystemExit:
            # tyro has printed the help of a command.
            return 0
        except BaseException as error:
            if not ending.number and not isinstance(error, KeyboardInterrupt):
                raise
            errors.print("stopped")
            forget_interrupt()
            return ending.status if ending.number else Stopped.status
    return 0


def _run(name: str, arguments: Sequence[str]) -> None:
    if name == "--version":
        from neilfpp_method import __version__

        print(f"neilfpp {__version__}")
        return
    if name not in COMMANDS:
        meant = closest(name, COMMANDS)
        remedy = f"did you mean neilfpp {meant}?" if meant else f"choose one of {', '.join(COMMANDS)}"
        raise UserError(f"unknown command '{name}'", remedy)
    command = COMMANDS[name]
    try:
        options = _resolve_run_folder(_parse(name, command, arguments))
        # Threads that numpy starts inherit the blocked signals, so only the main thread receives them.
        with signals_delayed():
            import numpy  # noqa: F401
        command.run(options)
    except OSError as error:
        # Errors of files that are not handled where they occur.
        where = f"{error.filename}: " if error.filename else ""
        remedy = "check that it exists, that it is readable and writable, and that the disk is not full"
        raise UserError(f"{where}{error.strerror or error}", remedy) from error


def _resolve_run_folder(options: Any) -> Any:
    """Replace the path of nerfstudio's `config.yml` by the run folder next to it."""
    if isinstance(getattr(options, "run", None), Path) and options.run.suffix == ".yml":
        from neilfpp_method.train.run import run_folder

        options.run = run_folder(options.run)
    return options


def _parse(name: str, command: Command, arguments: Sequence[str]) -> Any:
    """Parse the options of a command, or print its help.

    Raises:
        UserError: if the options are wrong.
        SystemExit: after help has been printed.
    """
    examples = "\n".join(f"  {example}" for example in command.examples)
    description = f"{command.summary}\n\nExamples:\n{examples}"
    keywords: dict[str, Any] = {"prog": f"neilfpp {name}", "description": description}
    if command.usual is not None:
        keywords["description"] += f"\n\nEvery setting: neilfpp {name} --help-all"
        if {"-h", "--help"} & set(arguments):
            tyro.cli(command.usual, args=["--help"], **keywords)
        arguments = ["--help" if argument == "--help-all" else argument for argument in arguments]
    if command.default is not None:
        keywords["default"] = command.default(arguments)
    complaint = io.StringIO()
    try:
        with redirect_stderr(complaint):
            return tyro.cli(command.options, args=arguments, **keywords)
    except SystemExit as end:
        # Without a complaint, tyro has printed the help.
        if not complaint.getvalue():
            raise
        found = mistake(complaint.getvalue(), arguments)
        what, meant = found.what, found.meant
        folder = next(iter(arguments), "-")
        if what == f"{TYRO_UNKNOWN} {folder}" and folder[:1] != "-" and "data" in _names(command):
            meant = f"--data {folder}"
        see = f"see neilfpp {name} --help"
        raise UserError(what, f"did you mean {meant}? Otherwise {see}" if meant else see) from end


def _names(command: Command) -> set[str]:
    """The names of the options of a command."""
    return {field.name for field in dataclasses.fields(command.options)}


def _overview() -> str:
    """The help of `neilfpp` without a command."""
    lines = [
        "neilfpp: geometry, material and light from posed images",
        "",
        "usage: neilfpp COMMAND [options]        neilfpp COMMAND --help",
        "",
        *(f"  {name:10} {command.summary}" for name, command in COMMANDS.items()),
        "",
        "examples:",
        "  neilfpp demo",
        "  neilfpp train --data captures/teapot --out runs/teapot",
        "  neilfpp eval runs/teapot",
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
