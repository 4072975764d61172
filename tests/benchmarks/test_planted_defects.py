"""The contract suite finds each planted defect, by the check that the table of docs/hosts.md names."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch

from benchmarks.planted_defects import DEFECTS, Scene, outcomes, rays_from_above
from neilfpp_method.hosts.testing import check_host

TABLE = Path(__file__).parents[2] / "docs" / "hosts.md"


@pytest.fixture(scope="module")
def found() -> dict[str, str | None]:
    state = torch.random.get_rng_state()
    result = {outcome.defect: outcome.check for outcome in outcomes()}
    torch.random.set_rng_state(state)
    return result


def test_the_host_without_defects_passes():
    assert check_host(Scene(), rays_from_above()).hits > 150


def test_all_defects_but_wrong_colors_are_found(found):
    """Without a photograph of known radiance, wrong colours cannot be detected."""
    missed = {name for name, check in found.items() if check is None}
    assert missed == {"colours in display values", "red and blue exchanged"}
    assert len(found) == len(DEFECTS) >= 55
    assert "crash" not in found.values()


def test_the_table_of_the_docs_is_this_one(found):
    rows = dict(re.findall(r"^\| ([^|]+) \| ([^|]+) \| [^|]*\|$", TABLE.read_text(), re.MULTILINE))
    assert {name: rows.get(name) for name in found} == {
        name: check or "**nothing**" for name, check in found.items()
    }
