"""Errors of JSON files: every one names the entry, and the remedy for that kind of file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from neilfpp_method.data.files.json_entry import Entry
from neilfpp_method.errors import UserError

MISTAKES = {
    "a.json: views.0.fx is missing": lambda entry: entry["views"].items()[0]["fx"],
    "a.json: views.0.size: not a JSON list": lambda entry: entry["views"].items()[0]["size"].items(),
    "a.json: views: not a JSON object": lambda entry: entry["views"].entries(),
    "a.json: views: not a finite number": lambda entry: entry["views"].number(),
}


@pytest.mark.parametrize("problem", MISTAKES)
@pytest.mark.parametrize("remedy", ["export the cameras again", "delete it"])
def test_the_remedy_of_a_file_is_that_of_all_its_entries(tmp_path: Path, problem: str, remedy: str) -> None:
    mistake: Callable[[Entry], object] = MISTAKES[problem]
    (tmp_path / "a.json").write_text('{"views": [{"size": 3}]}', "utf-8")
    entry = Entry.load(tmp_path / "a.json", remedy)
    with pytest.raises(UserError) as caught:
        mistake(entry)
    assert caught.value.problem.endswith(problem)
    assert caught.value.remedy == remedy


def test_a_file_that_is_not_json_has_the_same_remedy(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text("{", "utf-8")
    with pytest.raises(UserError, match="not valid JSON") as caught:
        Entry.load(tmp_path / "a.json", "delete it")
    assert caught.value.remedy == "delete it"
