"""Captures that no test may change; trainings that start soon, and checks of the shapes of first calls."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from neilfpp_method.train import command
from tests import shape_checks
from tests.coarse_hulls import start_geometry
from tests.data.make_capture import make_capture


def pytest_runtest_setup() -> None:
    shape_checks.start_test()


@pytest.fixture(scope="session")
def sphere_capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The capture of `make_capture`, without masks."""
    return make_capture(tmp_path_factory.mktemp("capture") / "sphere")


@pytest.fixture(scope="session")
def masked_capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same capture with masks."""
    return make_capture(tmp_path_factory.mktemp("capture") / "sphere", masks=True)


@pytest.fixture(scope="session", autouse=True)
def _coarse_hulls() -> Iterator[None]:
    """Trainings of tiny fields start from coarse hulls."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(command, "start_geometry", start_geometry)
        yield
