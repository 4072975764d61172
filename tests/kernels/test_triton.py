"""Triton's kernels without a GPU: run by the interpreter, and compiled for a GPU."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("triton")
ROOT = Path(__file__).parents[2]
OF_EVERY_BACKEND = ("tests/kernels/test_backends.py", "tests/kernels/test_encode.py")
"""The files of which the environment selects the backend."""
COMPILE = """
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource, compile
from neilfpp_method.kernels import triton as kernels

fixed = {"width": 2, "with_jacobian": True, "block": kernels.BLOCK}
for number in ("fp32", "fp64"):
    arrays = ("points", "table", "features", "jacobian", "gradient")
    kind_of = dict.fromkeys(arrays, "*" + number) | {"grid": "*i64"}
    for kernel in (kernels._interpolate, kernels._add_to_table, kernels._point_gradient):
        names = [parameter.name for parameter in kernel.params]
        kinds = {name: "constexpr" if name in fixed else kind_of.get(name, "i32") for name in names}
        source, target = ASTSource(kernel, kinds, fixed), GPUTarget("cuda", 80, 32)
        code = compile(source, target=target, options=kernels.FUSED)
        print(len(code.asm["cubin"]))
"""


def python(*arguments: str, **environment: str) -> str:
    done = subprocess.run(
        [sys.executable, *arguments],
        cwd=ROOT,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_the_tests_of_every_backend_hold_in_the_interpreter():
    words = ("-m", "pytest", "-x", "-p", "no:cacheprovider", *OF_EVERY_BACKEND)
    told = python(*words, TRITON_INTERPRET="1", OMP_NUM_THREADS="1")
    assert "passed" in told
    assert "failed" not in told


@pytest.mark.skipif(sys.platform != "linux", reason="needs Triton's compiler")
def test_the_kernels_compile_for_a_gpu(tmp_path):
    sizes = python("-c", COMPILE, TRITON_CACHE_DIR=str(tmp_path), TRITON_INTERPRET="0").split()
    assert len(sizes) == 6
    assert min(map(int, sizes)) > 1000
