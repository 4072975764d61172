"""What trainings of hard cases share."""

from __future__ import annotations

import jaxtyping
import pytest


@pytest.fixture(scope="module")
def without_shape_checks():
    """They cost two thirds of the time of a small step, and a hundred steps have the shapes of the first."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)
