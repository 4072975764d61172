"""The examples run, are short, and print the documented results."""

from __future__ import annotations

import runpy
from pathlib import Path

import pytest
import torch

EXAMPLES = sorted(
    (Path(__file__).parent.parent / "examples").glob("0[124]_*.py")
)  # the third needs nerfstudio


@pytest.fixture(params=EXAMPLES, ids=lambda path: path.stem)
def example(request) -> Path:
    return request.param


def test_an_example_is_short(example):
    assert len(example.read_text().splitlines()) < 80


def test_an_example_trains_a_material(example, capsys):
    torch.manual_seed(0)
    shown = runpy.run_path(str(example), run_name="__main__")
    assert "physical" in capsys.readouterr().out
    terms = shown["total"].terms
    assert terms["physical"] < 0.1  # of a radiance of 0.2 to 0.3; 0.3 and more at the start
    assert all(p.isfinite().all() for p in shown["neilf"].parameters())
