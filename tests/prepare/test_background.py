"""Native calls in a second thread: results, exceptions, and a stop that waits for the end of the call."""

from __future__ import annotations

import ast
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from neilfpp_method import prepare
from neilfpp_method.prepare.background import in_background, sigterm_as_ctrl_c


def test_the_result_is_returned_and_progress_is_updated():
    looks = []
    assert in_background(lambda token: time.sleep(0.5) or "done", lambda: looks.append(1)) == "done"
    assert len(looks) >= 2


def test_an_exception_is_raised_in_the_main_thread():
    def fail(token: object) -> None:
        raise ValueError("broken")

    with pytest.raises(ValueError, match="broken"):
        in_background(fail)


@contextmanager
def heard(number: signal.Signals) -> Iterator[None]:
    """Enable Ctrl-C: shells start background jobs with SIGINT ignored, and these tests may be such a job."""
    before = signal.signal(number, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(number, before)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_stop_cancels_the_call_and_waits_for_its_end(number):
    ended = []

    def work(token) -> None:
        while not token.is_cancelled:
            time.sleep(0.01)
        time.sleep(0.5)
        ended.append(1)

    threading.Timer(0.3, signal.pthread_kill, (threading.main_thread().ident, number)).start()
    before = signal.getsignal(signal.SIGTERM)
    with heard(signal.SIGINT), pytest.raises(KeyboardInterrupt), sigterm_as_ctrl_c():
        in_background(work)
    assert ended
    assert signal.getsignal(signal.SIGTERM) == before


def test_no_second_sqlite_library_opens_the_database():
    """Two SQLite libraries in one process ignore each other's locks; COLMAP then crashes with a bus error."""
    for path in Path(prepare.__file__).parent.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            names = (
                [alias.name for alias in node.names]
                if isinstance(node, ast.Import)
                else [getattr(node, "module", "")]
            )
            assert "sqlite3" not in names, path
