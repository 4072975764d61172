"""Call the command line, and check how it refuses."""

from __future__ import annotations

from pathlib import Path

from neilfpp_method.cli import main


def train(*options: object) -> int:
    return main(["train", "--preset", "tiny", "--device", "cpu", *map(str, options)])


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
