"""The table of effects in the terminal."""

from __future__ import annotations

import pytest
from rich.console import Console

from neilfpp_method.effects.plan import Decision, Plan
from neilfpp_method.effects.request import parse_effects
from neilfpp_method.effects.table import effects_table, rows
from neilfpp_method.settings.presets import PRESETS, preset


@pytest.mark.parametrize("name", list(PRESETS))
@pytest.mark.parametrize("effects", ["auto", "as-set", "none", "all"])
def test_no_word_is_broken_at_80_columns(name, effects):
    plan = Plan.begin(parse_effects(effects), preset(name))
    console = Console(width=80, markup=False, highlight=False)
    with console.capture() as captured:
        console.print(effects_table(plan))
    words = set(captured.get().split())
    for row in rows(plan):
        for column in ("effect", "decision", "reason", "cost", "risk"):
            assert set(row[column].split()) <= words


def test_a_long_file_name_is_shown_in_full():
    plan = Plan.begin(parse_effects("auto"), preset("fast"))
    name = "photographs-of-a-teapot-in-the-garden.exr"
    plan.decisions.append(Decision(0, "background", True, "files", name))
    console = Console(width=80, markup=False, highlight=False)
    with console.capture() as captured:
        console.print(effects_table(plan))
    shown = "".join(line[29:46].strip() for line in captured.get().splitlines())
    assert name in shown
