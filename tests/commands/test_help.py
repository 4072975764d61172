"""Help, completion and version."""

from __future__ import annotations

import io
import shutil
import subprocess
import sys
from contextlib import redirect_stdout

import pytest

from neilfpp_method.cli import COMMANDS, main


@pytest.fixture(scope="module")
def completion() -> str:
    """What `neilfpp completion bash` prints."""
    printed = io.StringIO()
    with redirect_stdout(printed):
        assert main(["completion", "bash"]) == 0
    return printed.getvalue()


@pytest.mark.parametrize("arguments", [[], ["--help"], ["-h"], ["help"]])
def test_help_names_the_commands(arguments, capsys):
    assert main(arguments) == 0
    said = capsys.readouterr().out
    for name, command in COMMANDS.items():
        assert f"  {name} " in said
        assert command.summary in said
    assert "examples:" in said


def test_help_may_come_first(capsys):
    assert main(["help", "render"]) == 0
    assert "neilfpp render runs/teapot --views all" in capsys.readouterr().out


@pytest.mark.parametrize("name", COMMANDS)
def test_help_of_a_command_shows_examples(name, capsys):
    assert main([name, "--help"]) == 0
    said = capsys.readouterr()
    assert said.err == ""
    assert "Examples:" in said.out
    for example in COMMANDS[name].examples:
        assert example.split("  ")[0] in said.out
        assert example.startswith(f"neilfpp {name}")


def test_the_examples_parse(monkeypatch):
    """Each example of the help is a command that the parser takes."""
    for name, command in COMMANDS.items():
        for example in command.examples:
            seen = []
            monkeypatch.setitem(
                COMMANDS, name, command.__class__(command.options, seen.append, command.examples)
            )
            assert main(example.split("  ")[0].split()[1:]) == 0
            assert isinstance(seen[0], command.options)


def test_help_of_train_fits_on_two_screens_and_all_of_it_is_one_option_away(capsys):
    assert main(["train", "--help"]) == 0
    usual = capsys.readouterr().out
    assert len(usual.splitlines()) <= 68
    assert "--help-all" in usual
    assert "--config FILE" in usual
    assert "--config.train.rays" not in usual
    assert main(["train", "--help-all"]) == 0
    assert "--config.train.rays" in capsys.readouterr().out


@pytest.mark.parametrize(
    "arguments", [["--help"], ["train", "--help"], ["train", "--data", "x", "--colour", "red"]]
)
def test_help_and_mistyped_options_do_not_wait_for_torch(arguments):
    asks = f"import sys; from neilfpp_method.cli import main; main({arguments})"
    asks += "; sys.exit('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", asks], capture_output=True, timeout=60, check=False)
    assert done.returncode == 0


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
@pytest.mark.parametrize(
    ("words", "completed"),
    [
        ("trai", "train"),
        ("train --da", "--data"),
        ("eval --check", "--checkpoint"),
        ("train --config.train.ra", "--config.train.rays"),
    ],
)
def test_bash_completes(completion, words, completed):
    """As bash asks: its variables are set, the registered function is called, and `COMPREPLY` is the
    answer.
    """
    before = ["neilfpp", *words.split()]
    ask = f"COMP_WORDS=({' '.join(before)}); COMP_CWORD={len(before) - 1}; COMP_LINE='neilfpp {words}'"
    call = "eval \"$(complete -p neilfpp | sed 's/.*-F \\([^ ]*\\).*/\\1/')\" neilfpp; echo ${COMPREPLY[@]}"
    script = f"{completion}\n{ask}; COMP_POINT=${{#COMP_LINE}}\n{call}"
    done = subprocess.run(["bash", "-c", script], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.split() == [completed]


def test_version(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("neilfpp 0.")
