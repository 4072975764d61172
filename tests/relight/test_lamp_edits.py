"""Lamps that the user moves or removes."""

from __future__ import annotations

import pytest
import torch

from neilfpp_method.data.views import Normalization
from neilfpp_method.errors import UserError
from neilfpp_method.relight.lamp_edits import edited_lamps, parse_lamp_edits
from neilfpp_method.relight.lamplight import Lamplight

FRAME = Normalization(2.0, (1.0, 0.0, 0.0))


def three_lamps() -> Lamplight:
    place = torch.tensor([[0.5, 0.0, 0.0], [0.0, 0.5, 0.0], [0.0, 0.0, 0.5]])
    axis = torch.tensor([[0.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 0.0]])
    return Lamplight(place, axis, torch.tensor([[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]]), 0.05)


def test_one_lamp_is_moved_one_removed_and_one_kept():
    lamps = three_lamps()
    changed = edited_lamps(lamps, parse_lamp_edits(["1=2,-1,0.5", "0 = off"]), FRAME)
    # The world is twice as large as the scene, with its centre at (1, 0, 0).
    assert changed.position.tolist() == [[0.5, -0.5, 0.25], [0.0, 0.0, 0.5]]
    assert changed.axis.tolist() == [[0.0, -1.0, 0.0], [0.0, 0.0, 0.0]]
    assert changed.radiance.tolist() == [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    assert lamps.position[1].tolist() == [0.0, 0.5, 0.0]


def test_all_lamps_are_removed():
    assert edited_lamps(three_lamps(), parse_lamp_edits(["0=off", "1=off", "2=off"]), FRAME) is None


def test_without_edits_nothing_changes():
    lamps = three_lamps()
    assert edited_lamps(lamps, [], FRAME) is lamps
    assert edited_lamps(None, [], FRAME) is None


@pytest.mark.parametrize(
    "text", ["0", "0=", "0=1,2", "0=1,2,3,4", "0=a,b,c", "0=nan,0,0", "-1=off", "x=off", "0=on"]
)
def test_invalid_edits_are_refused(text):
    with pytest.raises(UserError, match=f"--lamp {text}"):
        parse_lamp_edits([text])


def test_a_lamp_is_edited_only_once():
    with pytest.raises(UserError, match="--lamp 1 is given twice"):
        parse_lamp_edits(["1=off", "1=0,0,0"])


@pytest.mark.parametrize(("lamps", "has"), [(three_lamps(), "3, numbered from 0"), (None, "it has none")])
def test_a_missing_lamp_is_refused(lamps, has):
    with pytest.raises(UserError, match=has):
        edited_lamps(lamps, parse_lamp_edits(["3=off"]), FRAME)
