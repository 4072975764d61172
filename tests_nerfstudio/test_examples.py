"""The examples that need nerfstudio, run for two steps."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parent.parent / "examples"


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*nerfstudio*.py")), ids=lambda path: path.stem)
def test_the_example_runs_and_is_short(path: Path, monkeypatch, capsys) -> None:
    assert len(path.read_text().splitlines()) < 60
    monkeypatch.setattr(sys, "argv", [str(path), "2"])
    runpy.run_path(str(path))
    assert "of 128 rays meet one surface" in capsys.readouterr().out
