"""Commands that are killed at random moments lose no file, leave no incomplete file, give the same results,
and print no traceback.
"""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.data.make_capture import make_capture

REPOSITORY = Path(__file__).parents[3]
KILLS = int(os.environ.get("HARD_KILLS", "150"))
"""Kills of trainings in the long campaign; a tenth of it for each of nine other commands."""


def attack(folder: Path, seed: int, kills: int) -> dict:
    report = folder / "report.json"
    command = ["-m", "tests.hard_cases.faults.campaign", str(folder), str(report), str(seed), str(kills)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, *command], cwd=REPOSITORY, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return json.loads(report.read_text())


@pytest.mark.hard
@pytest.mark.timeout(3600)
def test_commands_are_killed_at_random_moments(tmp_path: Path, record_property) -> None:
    told = attack(tmp_path, seed=1, kills=KILLS)
    record_property("kills", sum(told["kills"].values()))
    record_property("files", told["files"])
    assert told["faults"] == []


def test_a_few_kills_of_trainings(tmp_path: Path) -> None:
    assert attack(tmp_path, seed=0, kills=4)["faults"] == []


@pytest.mark.hard
def test_a_sigterm_while_a_command_starts_prints_no_traceback(tmp_path: Path, record_property) -> None:
    """`tests/test_ending.py` sends signals at chosen moments."""
    root, draw = make_capture(tmp_path / "capture"), random.Random(0)
    command = [sys.executable, "-m", "neilfpp_method", "inspect", str(root)]
    began = time.monotonic()
    whole = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True)
    took = time.monotonic() - began
    assert whole.returncode == 0
    for _ in range(10):
        process = subprocess.Popen(
            command, cwd=REPOSITORY, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
        )
        time.sleep(draw.uniform(0.05, took))
        process.send_signal(signal.SIGTERM)
        _, said = process.communicate(timeout=120)
        assert process.returncode in (0, 143, -signal.SIGTERM)
        assert said in ("", "stopped\n")
    record_property("kills", 10)
