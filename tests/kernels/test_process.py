"""The settings of a process that computes, each in a process of its own: what is set stays set."""

from __future__ import annotations

import subprocess
import sys

import pytest
import torch

from neilfpp_method.kernels.process import half_precision, rounded_products

SMALL = "import torch\nsmall = lambda: (torch.full((64,), 1e-38) * 0.01).count_nonzero().item()\n"
RESIDENT = """
import torch
def resident():
    torch.ones(16_000_000)  # 64 MB, and gone at once
    return int(next(line for line in open("/proc/self/status") if line.startswith("VmRSS")).split()[1]) // 1024
"""


def say(program: str) -> list[str]:
    """What a program prints, by words."""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


def test_denormal_numbers_count_as_zero():
    if not torch.set_flush_denormal(False):
        pytest.skip("this processor has no such setting")
    program = "from neilfpp_method.kernels.process import computing_fast\n" + SMALL
    program += "print(small())\nwith computing_fast():\n    print(small())\nprint(small())"
    assert say(program) == ["64", "0", "64"]


@pytest.mark.skipif(sys.platform != "linux", reason="glibc alone is asked")
def test_memory_that_is_freed_is_kept():
    program = "from neilfpp_method.kernels.process import computing_fast\n" + RESIDENT
    program += "print(resident())\nwith computing_fast():\n    print(resident())\nprint(resident())"
    before, kept, after = map(int, say(program))
    assert kept > before + 50
    assert after < before + 10


@pytest.mark.parametrize(
    ("words", "does"),
    [
        (["train", "--data", "x"], "train.command.run_training"),
        (["demo"], "demo.run_demo"),
        (["eval", "x"], "evaluate.protocols.evaluate"),
    ],
)
def test_a_command_that_computes_makes_them(words, does):
    if not torch.set_flush_denormal(False):
        pytest.skip("this processor has no such setting")
    module, name = f"neilfpp_method.{does}".rsplit(".", 1)
    program = f"""{SMALL}
import {module} as place, neilfpp_method.train.run as run
from neilfpp_method.cli import main
def tell(*_, **__):
    print(small())
    raise KeyboardInterrupt
place.{name} = tell
run.load_run = lambda *_: None
main({words!r})
print(small())
"""
    first, *_, last = say(program)  # between them a bar of progress
    assert (first, last) == ("0", "64")


def product_error(rounded: bool) -> float:
    """How far a product is from its value in float64, relative."""
    generator = torch.Generator().manual_seed(0)
    a, b = (torch.randn(256, 256, generator=generator) for _ in range(2))
    with rounded_products(rounded):
        product = a @ b
    exact = a.double() @ b.double()
    return ((product - exact).norm() / exact.norm()).item()


def test_factors_are_rounded_where_that_is_asked_for_and_sums_are_not():
    assert product_error(rounded=False) < 1e-6
    # bfloat16 has 8 bits: two factors are 0.2 % off in the mean; sums of 8 bits would be several times that.
    assert product_error(rounded=True) < 4e-3
    assert product_error(rounded=False) < 1e-6  # and afterwards all is as before


def test_rounding_ends_with_an_error():
    before = torch.get_float32_matmul_precision()
    with pytest.raises(KeyError), rounded_products():
        raise KeyError(torch.get_float32_matmul_precision())
    assert torch.get_float32_matmul_precision() == before


@pytest.mark.parametrize("units", [True, False])
@pytest.mark.parametrize("wanted", [True, False])
def test_half_precision_is_taken_where_there_are_units_and_it_is_wanted(monkeypatch, units, wanted):
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"avx512_fp16": units}, raising=False)
    x = torch.randn(4, 3)
    with half_precision(torch.device("cpu"), wanted):
        inside = torch.nn.functional.linear(x, x).dtype
    assert inside == (torch.float16 if units and wanted else torch.float32)
    assert torch.nn.functional.linear(x, x).dtype == torch.float32


def test_half_precision_where_torch_does_not_say_what_there_is(monkeypatch):
    monkeypatch.delattr(torch.cpu, "get_capabilities", raising=False)
    with half_precision(torch.device("cpu")):
        assert torch.ones(2, 2).matmul(torch.ones(2, 2)).dtype == torch.float32
