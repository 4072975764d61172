"""Commands limit how long waiting OpenMP threads spin, before torch reads the limit."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from neilfpp_method.__main__ import SPIN_COUNT

PROGRAM = """
import os, sys

class Showing:
    def find_spec(self, name, *_):
        if name == "neilfpp_method.cli":
            print("torch" in sys.modules, os.environ.get("GOMP_SPINCOUNT"))

sys.meta_path.insert(0, Showing())
from neilfpp_method.__main__ import main
sys.exit(main())
"""


@pytest.mark.parametrize(
    ("chosen", "expected"),
    [
        ({}, SPIN_COUNT),
        ({"GOMP_SPINCOUNT": "7"}, "7"),
        ({"OMP_WAIT_POLICY": "active"}, None),
    ],
)
def test_waiting_threads_sleep_soon_unless_the_user_chose_otherwise(chosen, expected):
    inherited = {k: v for k, v in os.environ.items() if k not in ("GOMP_SPINCOUNT", "OMP_WAIT_POLICY")}
    command = [sys.executable, "-c", PROGRAM, "--help"]
    ended = subprocess.run(command, capture_output=True, text=True, env={**inherited, **chosen})
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout.splitlines()[0] == f"False {expected}"
