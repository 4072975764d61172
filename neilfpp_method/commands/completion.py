"""`neilfpp completion`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import tyro
from tyro.extras import subcommand_cli_from_dict

from neilfpp_method.commands.command import Command

__all__ = ["COMMAND"]


@dataclass
class Completion:
    """Print the script by which a shell completes commands and options."""

    shell: tyro.conf.Positional[Literal["bash", "zsh"]]
    """Which shell. The script goes where the shell looks for one; README.md has a line for each."""


def run(options: Completion) -> None:
    from neilfpp_method.commands import COMMANDS

    known = {name: command.options for name, command in COMMANDS.items()}
    subcommand_cli_from_dict(known, prog="neilfpp", args=["--tyro-print-completion", options.shell])


COMMAND = Command(Completion, run, ["neilfpp completion bash", "neilfpp completion zsh"])
