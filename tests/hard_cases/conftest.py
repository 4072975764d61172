"""Fixtures for trainings of hard cases, and the counts that `make test-hard` prints at its end."""

from __future__ import annotations

from collections import Counter

import jaxtyping
import pytest

COUNTED = ("inputs", "kills", "files", "mutants")
"""What tests count with `record_property`."""


@pytest.fixture(scope="module")
def without_shape_checks():
    """Shape checks take two thirds of the time of a small step, and all steps have the shapes of the
    first.
    """
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Print one line with the counts if hard cases were run."""
    counts: Counter[str] = Counter()
    for reports in terminalreporter.stats.values():
        for report in reports:
            if getattr(report, "when", None) == "call" and "hard" in report.keywords:
                counts["cases"] += 1
                counts.update({name: n for name, n in report.user_properties if name in COUNTED})
    if counts["cases"]:
        told = ", ".join(f"{counts[name]:,} {name}" for name in ("cases", *COUNTED))
        terminalreporter.write_line(f"hard: {told}")
