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
    """Print the completion script of a shell, for the commands and their options."""

    shell: tyro.conf.Positional[Literal["bash", "zsh"]]
    """The shell. README.md says where to store the script."""


def run(options: Completion) -> None:
    from neilfpp_method.commands import COMMANDS

    commands = {name: command.options for name, command in COMMANDS.items()}
    subcommand_cli_from_dict(commands, prog="neilfpp", args=["--tyro-print-completion", options.shell])


COMMAND = Command(Completion, run, ["neilfpp completion bash", "neilfpp completion zsh"])
