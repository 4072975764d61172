"""A small capture, and a run that the command line has trained on it."""

from __future__ import annotations

from pathlib import Path

import pytest

from neilfpp_method.settings.presets import PRESETS
from tests.commands.calls import train
from tests.data.make_capture import make_capture
from tests.train.small_runs import small_config


@pytest.fixture(autouse=True)
def _tiny_preset(monkeypatch):
    monkeypatch.setitem(PRESETS, "tiny", small_config)


@pytest.fixture(scope="package")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_capture(tmp_path_factory.mktemp("capture") / "sphere", masks=True)


@pytest.fixture(scope="package")
def trained(tmp_path_factory: pytest.TempPathFactory, capture: Path) -> Path:
    out = tmp_path_factory.mktemp("runs") / "sphere"
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(PRESETS, "tiny", small_config)
        assert train("--data", capture, "--out", out) == 0
    return out
