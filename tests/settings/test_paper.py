"""docs/paper.md agrees with the presets: the tables are read, so neither can change without the other."""

from __future__ import annotations

import ast
import dataclasses
import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest

from neilfpp_method.settings.presets import fixed_geometry, preset
from neilfpp_method.settings.types import NeilfConfig

PAGE = Path(__file__).parents[2] / "docs" / "paper.md"
BASED_ON = {"paper-ngp": "paper-mlp", "paper-ngp-hdr": "paper-ngp", "paper-mlp-mesh": "paper-mlp"}
PRESETS = ("paper-mlp", *BASED_ON)
NOT_COMPARED = {"preset"}
"""Settings that are only labels."""


@dataclasses.dataclass(frozen=True)
class Row:
    """A row of a table: the value of the published code (None if there is nothing to compare), the value of
    the preset, and the reason.
    """

    published: object
    ours: object
    why: str


def value(cell: str) -> object:
    """The literal of a cell; none of them is a string that says n/a."""
    return None if cell == "n/a" else ast.literal_eval(re.fullmatch(r"`(.+)`", cell)[1])


def table(name: str) -> Mapping[str, Row]:
    """The rows under the heading of a preset by setting, in addition to those of the preset that it is based
    on.
    """
    section = PAGE.read_text(encoding="utf-8").split(f"## `{name}`\n")[1].split("\n## ")[0]
    rows = [
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in section.splitlines()
        if line.startswith("| `")
    ]
    assert rows
    assert len({row[0] for row in rows}) == len(rows)
    found = {path.strip("`"): Row(value(code), value(ours), why) for path, _, code, ours, why in rows}
    return {**(table(BASED_ON[name]) if name in BASED_ON else {}), **found}


def settings(name: str) -> NeilfConfig:
    return fixed_geometry(preset("paper-mlp")) if name == "paper-mlp-mesh" else preset(name)


def rows_of(name: str) -> Mapping[str, Row]:
    """The rows of settings that the preset has: with a mesh there is no G."""
    of_geometry = ("host.sdf.", "host.volume.", "host.loss.") if name.endswith("-mesh") else ()
    return {path: row for path, row in table(name).items() if not path.startswith(of_geometry)}


def setting(config: NeilfConfig, path: str) -> object:
    found: object = config
    for part in path.split("."):
        found = getattr(found, part)
    return found


def setting_paths(part: object, path: str = "") -> Iterator[str]:
    """The dotted paths of all settings in a part of the settings."""
    if not dataclasses.is_dataclass(part):
        yield path
        return
    for field in dataclasses.fields(part):
        yield from setting_paths(getattr(part, field.name), f"{path}.{field.name}".removeprefix("."))


def equal(one: object, other: object) -> bool:
    return one == (pytest.approx(other, rel=1e-4) if isinstance(other, float | tuple) else other)


@pytest.mark.parametrize("name", PRESETS)
def test_the_preset_agrees_with_the_table(name):
    config = settings(name)
    wrong = {
        path: setting(config, path)
        for path, row in rows_of(name).items()
        if not equal(setting(config, path), row.ours)
    }
    assert not wrong


@pytest.mark.parametrize("name", PRESETS)
def test_every_difference_from_the_published_code_has_its_reason(name):
    unexplained = [
        path for path, row in table(name).items() if not equal(row.published, row.ours) and len(row.why) < 9
    ]
    assert not unexplained


@pytest.mark.parametrize("name", PRESETS)
def test_the_table_has_every_setting(name):
    assert set(setting_paths(settings(name))) - NOT_COMPARED == set(rows_of(name))


def replace_in_page(monkeypatch, tmp_path, row: str, other: str) -> None:
    text = PAGE.read_text(encoding="utf-8")
    assert row in text
    page = tmp_path / "paper.md"
    page.write_text(text.replace(row, other), encoding="utf-8")
    monkeypatch.setattr("tests.settings.test_paper.PAGE", page)


def test_a_wrong_table_is_detected(monkeypatch, tmp_path):
    row = "| `host.loss.eikonal` | 0.1 | `0.1` | `0.1` |"
    replace_in_page(monkeypatch, tmp_path, row, "| `host.loss.eikonal` | 0.1 | `0.1` | `0.2` |")
    with pytest.raises(AssertionError):
        test_the_preset_agrees_with_the_table("paper-mlp")


def test_a_missing_row_is_detected(monkeypatch, tmp_path):
    replace_in_page(monkeypatch, tmp_path, "| `train.seed` |", "| seed |")
    with pytest.raises(AssertionError, match=r"train\.seed"):
        test_the_table_has_every_setting("paper-mlp")
