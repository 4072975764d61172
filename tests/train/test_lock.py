"""Two trainings do not share a run folder, and a killed one is in nobody's way."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from neilfpp_method.errors import UserError
from neilfpp_method.train.lock import LOCK, run_lock
from neilfpp_method.train.run import check_free

HOLDER = "import sys, time; from pathlib import Path; from neilfpp_method.train.lock import run_lock\n" \
    "with run_lock(Path(sys.argv[1])):\n    print('held', flush=True)\n    time.sleep(60)"  # fmt: skip


def holder(folder: Path) -> subprocess.Popen[str]:
    process = subprocess.Popen([sys.executable, "-c", HOLDER, str(folder)], stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "held\n"
    return process


def test_the_second_is_refused_until_the_first_is_gone(tmp_path):
    folder = tmp_path / "run"
    with holder(folder) as process:
        with (
            pytest.raises(UserError, match=rf"another training is running .*\(process {process.pid}\)"),
            run_lock(folder),
        ):
            pytest.fail("two at once")
        assert (folder / LOCK).exists()
        process.send_signal(signal.SIGKILL)
    assert (folder / LOCK).exists()  # nobody could take it away
    with run_lock(folder):
        pass
    assert not (folder / LOCK).exists()


def test_it_is_let_go_of_after_an_error(tmp_path):
    for _ in range(2):
        with pytest.raises(ZeroDivisionError), run_lock(tmp_path):
            raise ZeroDivisionError
    assert not list(tmp_path.iterdir())


def test_other_processes_of_one_training_are_let_in(tmp_path, monkeypatch):
    with run_lock(tmp_path):
        monkeypatch.setenv("LOCAL_RANK", "1")
        with run_lock(tmp_path):
            pass
        monkeypatch.setenv("LOCAL_RANK", "0")
        with pytest.raises(UserError), run_lock(tmp_path):
            pytest.fail("two at once")


def test_what_a_killed_training_left_before_it_was_a_run_is_in_nobodys_way(tmp_path):
    for name in (LOCK, "capture.json", "scene.json", ".config.4711.json"):
        (tmp_path / name).write_text("{")
    check_free(tmp_path)
    for name in ("config.json", "notes.txt", ".config.json"):
        (tmp_path / name).write_text("{}")
        with pytest.raises(UserError, match="exists already"):
            check_free(tmp_path)
        (tmp_path / name).unlink()
