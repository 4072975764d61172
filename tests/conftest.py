"""Captures that tests of several folders read. No test may change them."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.data.make_capture import make_capture


@pytest.fixture(scope="session")
def sphere_capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The capture of `make_capture`, without masks."""
    return make_capture(tmp_path_factory.mktemp("capture") / "sphere")


@pytest.fixture(scope="session")
def masked_capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same capture with masks."""
    return make_capture(tmp_path_factory.mktemp("capture") / "sphere", masks=True)
