"""Process-wide settings, each tested in a separate process, because they cannot be undone."""

from __future__ import annotations

import subprocess
import sys

import pytest
import torch

SMALL = "import torch\nsmall = lambda: (torch.full((64,), 1e-38) * 0.01).count_nonzero().item()\n"
RESIDENT = """
import torch
def resident():
    torch.ones(16_000_000)  # 64 MB, and gone at once
    rss = next(line for line in open("/proc/self/status") if line.startswith("VmRSS"))
    return int(rss.split()[1]) // 1024
"""


def say(program: str) -> list[str]:
    """The words that a program prints."""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


def test_denormal_numbers_are_flushed_to_zero():
    if not torch.set_flush_denormal(False):
        pytest.skip("this processor has no such setting")
    program = "from neilfpp_method.kernels.process import computing_fast\n" + SMALL
    program += "print(small())\nwith computing_fast():\n    print(small())\nprint(small())"
    assert say(program) == ["64", "0", "64"]


@pytest.mark.skipif(sys.platform != "linux", reason="glibc alone is asked")
def test_freed_memory_is_kept():
    program = "from neilfpp_method.kernels.process import computing_fast\n" + RESIDENT
    program += "print(resident())\nwith computing_fast():\n    print(resident())\nprint(resident())"
    before, kept, after = map(int, say(program))
    assert kept > before + 50
    assert after < before + 10


@pytest.mark.parametrize(
    ("words", "does"),
    [
        (["train", "--data", "x"], "train.command.run_training"),
        (["demo"], "demo.command.run_demo"),
        (["eval", "x"], "evaluate.protocols.evaluate"),
    ],
)
def test_commands_that_compute_change_the_settings(words, does):
    if not torch.set_flush_denormal(False):
        pytest.skip("this processor has no such setting")
    module, name = f"neilfpp_method.{does}".rsplit(".", 1)
    program = f"""{SMALL}
import {module} as place, neilfpp_method.evaluate.size as size, neilfpp_method.train.run as run
from neilfpp_method.cli import main
def tell(*_, **__):
    print(small())
    raise KeyboardInterrupt
place.{name} = tell
run.load_run = lambda *_: None
size.at_size, size.describe_size = lambda run, *_: run, lambda run: ""
main({words!r})
print(small())
"""
    first, *_, last = say(program)  # between them a bar of progress
    assert (first, last) == ("0", "64")
