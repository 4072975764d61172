"""The capture of most tests of trainings."""

from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture(scope="package")
def capture(sphere_capture: Path) -> Path:
    return sphere_capture
