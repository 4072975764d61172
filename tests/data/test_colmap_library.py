"""pycolmap and OpenCV share a process, whichever module of ours is loaded first."""

from __future__ import annotations

import ast
import subprocess
import sys

import pytest

from tests.test_architecture import SOURCES, imports

WRITE = """
import numpy as np, pathlib, sys
from neilfpp_method.data.images import read_image, write_png
path = pathlib.Path(sys.argv[1])
samples = np.random.default_rng(0).integers(0, 255, (64, 48, 3), dtype=np.uint8)
write_png(path, samples)
assert (np.rint(255 * read_image(path).pixels) == samples).all()
"""


@pytest.mark.parametrize("first", ["data.lens", "data.colmap_library"])
def test_png_files_are_written_after_a_module_with_pycolmap(tmp_path, first):
    program = f"import neilfpp_method.{first}\n{WRITE}"
    done = subprocess.run([sys.executable, "-c", program, tmp_path / "a.png"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_one_module_loads_pycolmap():
    loading = [name for name, path in SOURCES.items() if "pycolmap" in imports(ast.parse(path.read_text()))]
    assert loading == ["neilfpp_method.data.colmap_library"]
