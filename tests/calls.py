"""Call the command line: train a tiny run, and check how a command refuses bad input."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from neilfpp_method.cli import main
from neilfpp_method.settings.presets import PRESETS
from neilfpp_method.settings.types import NeilfConfig
from tests.train.small_runs import short_light_fits, small_config


def train_tiny(
    capture: Path, out: Path, *options: object, config: Callable[[], NeilfConfig] = small_config
) -> Path:
    """Train a run with the command line and return its folder; `config` makes the settings.

    Light fits are short.
    """
    command = ["train", "--data", capture, "--out", out, "--preset", "tiny", "--device", "cpu", *options]
    with short_light_fits(), pytest.MonkeyPatch.context() as patch:
        patch.setitem(PRESETS, "tiny", config)
        assert main([*map(str, command)]) == 0
    return out


def tree(folder: Path) -> dict[Path, bytes | None]:
    """Everything in a folder."""
    return {path: path.read_bytes() if path.is_file() else None for path in folder.rglob("*")}


def refused(capfd, arguments: list[object], *words: object, leaves: Path) -> None:
    """The command ends with 2 and one line that has these words and a remedy, and changes nothing in a
    folder.
    """
    before = tree(leaves)
    capfd.readouterr()
    assert main([str(argument) for argument in arguments]) == 2
    said = capfd.readouterr().err
    assert said.count("\n") == 1
    assert said.startswith("error: ")
    assert len(said.split("; ")) >= 2
    assert said.split("; ")[-1].strip()
    for word in words:
        assert str(word) in said
    assert tree(leaves) == before
