"""Faults that are planted one at a time: a quick test detects each."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.mutants.faults import MUTANTS
from benchmarks.mutants.planting import planted
from benchmarks.mutants.table import DOCUMENT

REPOSITORY = Path(__file__).parents[2]


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.what)
def test_a_fault_can_be_planted_and_its_tests_exist(mutant):
    source = (REPOSITORY / "neilfpp_method" / mutant.module).read_text()
    compile(planted(mutant, source), mutant.module, "exec")
    assert (REPOSITORY / "tests" / mutant.tests).is_file()


def test_a_fault_whose_code_has_changed_is_an_error():
    with pytest.raises(ValueError, match="0 places in shading/"):
        planted(MUTANTS[0], "nothing")


def test_the_rows_of_the_table_are_current_faults():
    rows = re.findall(r"^\| (.+?) \| `(.+?)` \| `.+?` \|$", DOCUMENT.read_text("utf-8"), re.MULTILINE)
    assert rows
    assert set(rows) <= {(mutant.what, mutant.module) for mutant in MUTANTS}


@pytest.mark.hard
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("half", [1, 2])
def test_all_faults_are_detected(half, record_property):
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "benchmarks.mutants", "--part", str(half), "2"]
    done = subprocess.run(command, cwd=REPOSITORY, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    record_property("mutants", len(MUTANTS[half - 1 :: 2]))
