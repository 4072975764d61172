"""Messages are one printable line, whatever the names and contents of files are."""

from __future__ import annotations

import pytest

from neilfpp_method.cli import main
from neilfpp_method.errors import UserError


@pytest.mark.parametrize(
    ("name", "shown"),
    [
        ("two\nlines", "two\\nlines"),
        ("\x1b[31mred", "\\x1b[31mred"),
        ("right\u202eto left", "right\\u202eto left"),
        ("no text \udcff", "no text \\udcff"),
        ("été 3×4 — 雪", "été 3×4 — 雪"),
    ],
)
def test_a_message_is_one_printable_line(name, shown):
    error = UserError(f"{name}: cannot be read", f"rename {name}")
    assert str(error) == f"{shown}: cannot be read; rename {shown}"
    assert error.problem == f"{shown}: cannot be read"
    str(error).encode()


def test_long_messages_of_libraries_are_shortened(capfd):
    error = UserError("a.off: " + 10_000 * "x" + "(end)", "export it again")
    assert len(error.problem) < 1600
    assert error.problem.startswith("a.off: xxx")
    assert error.problem.endswith("xx(end)")


def test_the_command_prints_such_a_message(capfd):
    assert main(["inspect", "no\nsuch\x07folder"]) == 2
    assert capfd.readouterr().err.startswith("error: no\\nsuch\\x07folder: no such folder; ")
