"""Damaged files: every reader returns a valid value or an error of one line.

A damaged file must not cause a traceback, a hang, a large use of memory, a crash of a native library, a read
outside of the capture, or the execution of code. docs/stability.md has the counts and the memory of the long
campaign.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.hard_cases.hostile.mutations import mutated
from tests.hard_cases.hostile.readers import READERS

REPOSITORY = Path(__file__).parents[3]
QUICK = {name: 40 if reader.share == 1.0 else 6 for name, reader in READERS.items()}
INPUTS = int(os.environ.get("HARD_INPUTS", "2000"))
"""Inputs of a cheap reader in the long campaign; 10000 take an hour or two."""


def attack(folder: Path, counts: dict[str, int], first: int) -> dict[str, dict]:
    """The outcomes of so many damaged files of each reader."""
    report = folder / "report.json"
    words = [f"{name}={count}" for name, count in counts.items()]
    command = ["-m", "tests.hard_cases.hostile.worker", str(folder), str(report), str(first), *words]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, *command], cwd=REPOSITORY, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return json.loads(report.read_text())


def check(outcomes: dict[str, dict], counts: dict[str, int]) -> None:
    for name, outcome in outcomes.items():
        assert not outcome["faults"], f"{name}: {outcome['faults'][:3]}"
        assert outcome["read"] + outcome["refused"] == counts[name]
        assert outcome["refused"] > 0, f"{name}: nothing was damaged"


def test_every_reader_handles_a_few_damaged_files(tmp_path: Path) -> None:
    check(attack(tmp_path, QUICK, first=0), QUICK)


@pytest.mark.hard
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("name", READERS)
def test_a_reader_handles_thousands_of_damaged_files(tmp_path: Path, record_property, name: str) -> None:
    counts = {name: round(INPUTS * READERS[name].share)}
    outcomes = attack(tmp_path, counts, first=1000)
    record_property("inputs", counts[name])
    record_property("files", 1)
    check(outcomes, counts)


def test_the_same_number_gives_the_same_damage() -> None:
    data = bytes(range(256)) * 8
    assert [mutated(data, i) for i in range(50)] == [mutated(data, i) for i in range(50)]
    assert len({mutated(data, i) for i in range(50)}) > 40


def faults_of(program: str, folder: Path) -> list:
    """The faults that a program prints as JSON in its last line."""
    done = subprocess.run(
        [sys.executable, "-c", program, str(folder)], cwd=REPOSITORY, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def test_the_worker_detects_faults(tmp_path: Path) -> None:
    """A traceback, a crash and a large allocation are faults, each reported with its number, and the next
    input is read.
    """
    program = """
import ctypes, json, sys
from pathlib import Path
from tests.hard_cases.hostile import worker
from tests.hard_cases.hostile.readers import Reader

def make(folder):
    (folder / "a").write_bytes(bytes(64))
    return [folder / "a"]

calls = []
def read(folder, path):
    calls.append(path)
    if len(calls) == 3: raise KeyError("x")
    if len(calls) == 5: bytearray(4 << 30)
    if len(calls) == 7: ctypes.string_at(0)

outcome = worker.attack(Reader(make, read), Path(sys.argv[1]) / "x", 10, 6)
print(json.dumps([[fault[0], fault[2]] for fault in outcome.faults]))
"""
    faults = faults_of(program, tmp_path)
    assert [number for number, _ in faults] == [11, 13, 15], faults
    for (_, told), word in zip(faults, ("KeyError", "MemoryError", "SIGSEGV"), strict=True):
        assert word in told


def test_the_worker_limits_the_computing_time(tmp_path: Path) -> None:
    """An endless loop is ended after the limit of computing time. Waiting, as on a loaded machine, is
    permitted for much longer.
    """
    program = """
import json, sys, time
from pathlib import Path
from tests.hard_cases.hostile import worker
from tests.hard_cases.hostile.readers import Reader

worker.LONGEST, worker.ENDED_AFTER, worker.LONGEST_BY_CLOCK = 0.2, 0.5, 4

def make(folder):
    (folder / "a").write_bytes(bytes(64))
    return [folder / "a"]

def compute(seconds):
    began = time.process_time()
    while time.process_time() - began < seconds: pass

def read(folder, path):
    at = folder.parent / "at"
    number = int.from_bytes(at.read_bytes(), "little") if at.exists() else 0
    if number == 10: time.sleep(1.0)
    if number == 11: compute(60.0)
    if number == 13: compute(0.3)
    if number == 14: time.sleep(60.0)

outcome = worker.attack(Reader(make, read), Path(sys.argv[1]) / "x", 10, 6)
print(json.dumps([[fault[0], fault[2]] for fault in outcome.faults]))
"""
    # This reader looks up the number of its input outside of the folder, which is reported, too.
    faults = [fault for fault in faults_of(program, tmp_path) if not fault[1].startswith("open ")]
    assert [number for number, _ in faults] == [11, 13, 14], faults
    for (_, what), word in zip(faults, ("SIGPROF", "seconds", "SIGALRM"), strict=True):
        assert word in what
