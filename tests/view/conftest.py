"""Tiny runs to view: with a recovered surface, and with a given mesh."""

from __future__ import annotations

import socket
from pathlib import Path

import pytest

from tests.calls import train_tiny
from tests.train.small_runs import few_steps, solved_light


@pytest.fixture(scope="package")
def capture(masked_capture) -> Path:
    return masked_capture


@pytest.fixture(scope="package")
def found(tmp_path_factory, capture) -> Path:
    """A run with a recovered surface and an environment map."""
    out = tmp_path_factory.mktemp("runs") / "found"
    return train_tiny(capture, out, config=lambda: solved_light(few_steps()))


@pytest.fixture(scope="package")
def given(tmp_path_factory, capture) -> Path:
    """A run with the capture's mesh and a light that is free at every point."""
    return train_tiny(capture, tmp_path_factory.mktemp("runs") / "given", "--host", "mesh", config=few_steps)


@pytest.fixture
def port() -> int:
    """A free port."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]
