"""Plant faults in a copy of the package, and run the tests of each until the first failure.

The tests run in a forked process that imports only the changed copy.
"""

from __future__ import annotations

import importlib
import os
import shutil
import signal
import sys
import tempfile
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path

from benchmarks.mutants.mutant import Mutant

__all__ = ["ROOT", "Outcome", "planted", "try_all"]

ROOT = Path(__file__).parents[2]
"""The repository."""
LOADED_BEFORE = (
    "pytest",
    "numpy",
    "scipy.spatial",
    "torch",
    "cv2",
    "pycolmap",
    "trimesh",
    "skimage",
    "OpenEXR",
    "lightning_fabric",
    "hypothesis",
)
"""Packages that the tests import, loaded once and shared by all processes."""
LONGEST = 300.0
"""Seconds of computation that the tests of one fault may take."""
LONGEST_BY_CLOCK = 3000
"""Seconds of wall-clock time that they may take."""


@dataclass(frozen=True)
class Outcome:
    """A fault, and the first of its tests that failed; None if all passed."""

    mutant: Mutant
    noticed_by: str | None


def planted(mutant: Mutant, source: str) -> str:
    """Return the source of a module with the fault.

    Raises:
        ValueError: the code to change does not occur exactly once.
    """
    if source.count(mutant.old) != 1:
        raise ValueError(
            f"{mutant.what}: {source.count(mutant.old)} places in {mutant.module} read {mutant.old!r}"
        )
    return source.replace(mutant.old, mutant.new)


def try_all(
    mutants: Sequence[Mutant], on_outcome: Callable[[Outcome], None] = lambda _: None
) -> list[Outcome]:
    """Run the tests of each fault; before that, run them once without a fault.

    Args:
        mutants: the faults.
        on_outcome: called with each outcome as soon as it is known.

    Raises:
        RuntimeError: a test fails without a fault.
    """
    for name in LOADED_BEFORE:
        importlib.import_module(name)
    outcomes = []
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder)
        ignored = shutil.ignore_patterns("__pycache__")
        for name in ("neilfpp_method", "tests", "benchmarks"):
            shutil.copytree(ROOT / name, copy / name, ignore=ignored)
        passing: set[str] = set()
        for mutant in mutants:
            if mutant.tests not in passing and (failed := _first_failure(copy, mutant.tests)):
                raise RuntimeError(f"without any fault: {failed}")
            passing.add(mutant.tests)
            path = copy / "neilfpp_method" / mutant.module
            whole = path.read_text()
            path.write_text(planted(mutant, whole))
            outcomes.append(Outcome(mutant, _first_failure(copy, mutant.tests)))
            path.write_text(whole)
            on_outcome(outcomes[-1])
    return outcomes


class _Failures:
    """A pytest plugin that writes the first failure to a file."""

    def __init__(self, place: Path) -> None:
        self.place = place

    def pytest_runtest_logreport(self, report) -> None:
        if report.failed and not self.place.exists():
            self.place.write_text(report.nodeid)

    def pytest_collectreport(self, report) -> None:
        self.pytest_runtest_logreport(report)


def _first_failure(copy: Path, tests: str) -> str | None:
    """The first test of a file that fails, or how their process ended; None if all pass."""
    failed = copy / "failed"
    failed.unlink(missing_ok=True)
    child = os.fork()
    if not child:
        # Either signal ends the process.
        signal.setitimer(signal.ITIMER_PROF, LONGEST)
        signal.alarm(LONGEST_BY_CLOCK)
        os.chdir(copy)
        sys.dont_write_bytecode = True
        # An editable install finds the package by its name; here it is the copy.
        sys.path.insert(0, str(copy))
        for name in [
            name for name in sys.modules if name.split(".")[0] in ("neilfpp_method", "tests", "benchmarks")
        ]:
            del sys.modules[name]
        import pytest

        options = ["-x", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", "-m", "not slow and not hard"]
        options += ["--rootdir", str(copy), "-c", os.devnull, "-W", "ignore", "--import-mode=append"]
        with open(copy / "output", "w") as output, redirect_stdout(output), redirect_stderr(output):
            status = pytest.main([*options, f"tests/{tests}"], plugins=[_Failures(failed)])
        os._exit(int(status))
    _, status = os.waitpid(child, 0)
    if failed.exists():
        return failed.read_text()
    return None if status == 0 else f"{tests}: ends with {status}: {(copy / 'output').read_text()[-1000:]}"
