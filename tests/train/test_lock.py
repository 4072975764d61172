"""Two trainings cannot use the same run folder, and a killed training does not block it."""

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


def test_the_second_training_is_refused_until_the_first_has_ended(tmp_path):
    folder = tmp_path / "run"
    with holder(folder) as process:
        with (
            pytest.raises(UserError, match=rf"another training is running .*\(process {process.pid}\)"),
            run_lock(folder),
        ):
            pytest.fail("two at once")
        assert (folder / LOCK).exists()
        process.send_signal(signal.SIGKILL)
    assert (folder / LOCK).exists()  # it was not removed
    with run_lock(folder):
        pass
    assert not (folder / LOCK).exists()


def test_the_lock_is_released_after_an_error(tmp_path):
    for _ in range(2):
        with pytest.raises(ZeroDivisionError), run_lock(tmp_path):
            raise ZeroDivisionError
    assert not list(tmp_path.iterdir())


def test_other_processes_of_a_training_do_not_lock(tmp_path, monkeypatch):
    with run_lock(tmp_path):
        monkeypatch.setenv("LOCAL_RANK", "1")
        with run_lock(tmp_path):
            pass
        monkeypatch.setenv("LOCAL_RANK", "0")
        with pytest.raises(UserError), run_lock(tmp_path):
            pytest.fail("two at once")


def test_files_of_a_training_killed_before_its_run_existed_are_ignored(tmp_path):
    for name in (LOCK, "capture.json", "scene.json", ".config.4711.json"):
        (tmp_path / name).write_text("{")
    check_free(tmp_path)
    for name in ("config.json", "notes.txt", ".config.json"):
        (tmp_path / name).write_text("{}")
        with pytest.raises(UserError, match="exists already"):
            check_free(tmp_path)
        (tmp_path / name).unlink()
