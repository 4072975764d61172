"""Defaults of relighting: the command states them for `--help`, other programs get them from the request."""

from __future__ import annotations

from pathlib import Path

from neilfpp_method.commands.relight import Relight
from neilfpp_method.relight.request import RelightRequest


def test_request_and_command_have_the_same_defaults():
    assert RelightRequest(**vars(Relight(Path("run")))) == RelightRequest(Path("run"))
    assert list(vars(Relight(Path("run")))) == list(vars(RelightRequest(Path("run"))))
