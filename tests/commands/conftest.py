"""A run that the command line has trained on a small capture."""

from __future__ import annotations

from pathlib import Path

import pytest

from neilfpp_method.settings.presets import PRESETS
from tests.calls import train_tiny
from tests.train.small_runs import small_config


@pytest.fixture(autouse=True)
def _tiny_preset(monkeypatch):
    monkeypatch.setitem(PRESETS, "tiny", small_config)


@pytest.fixture(scope="package")
def capture(masked_capture: Path) -> Path:
    return masked_capture


@pytest.fixture(scope="package")
def trained(tmp_path_factory: pytest.TempPathFactory, capture: Path) -> Path:
    return train_tiny(capture, tmp_path_factory.mktemp("runs") / "sphere")
