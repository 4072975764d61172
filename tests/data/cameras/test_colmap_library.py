"""pycolmap and OpenCV work in one process, whichever module of the package is imported first."""

from __future__ import annotations

import ast
import os
import signal
import subprocess
import sys

import pytest

from tests.test_architecture import SOURCES, imports

WRITE = """
import numpy as np, pathlib, sys
from neilfpp_method.data.files.images import read_image, write_png
path = pathlib.Path(sys.argv[1])
samples = np.random.default_rng(0).integers(0, 255, (64, 48, 3), dtype=np.uint8)
write_png(path, samples)
assert (np.rint(255 * read_image(path).pixels) == samples).all()
"""


@pytest.mark.parametrize("first", ["data.cameras.lens", "data.cameras.colmap_library"])
def test_png_files_are_written_after_a_module_with_pycolmap(tmp_path, first):
    program = f"import neilfpp_method.{first}\n{WRITE}"
    done = subprocess.run([sys.executable, "-c", program, tmp_path / "a.png"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_sigterm_ends_a_process_without_a_stack_trace():
    program = (
        "import os, signal, neilfpp_method.data.cameras.colmap_library; os.kill(os.getpid(), signal.SIGTERM)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (-signal.SIGTERM, "")


def test_one_module_loads_pycolmap():
    loading = [name for name, path in SOURCES.items() if "pycolmap" in imports(ast.parse(path.read_text()))]
    assert loading == ["neilfpp_method.data.cameras.colmap_library"]


@pytest.mark.parametrize("version", ["3.13.0", "4.1.2", "5.0.0.dev0"])
@pytest.mark.parametrize("command", ["prepare", "inspect"])
def test_another_version_of_pycolmap_is_refused_in_one_line(tmp_path, version, command):
    (tmp_path / "pycolmap.py").write_text(f"__version__ = '{version}'\n")
    program = "import sys; from neilfpp_method.cli import main; sys.exit(main())"
    line = [
        sys.executable,
        "-c",
        program,
        command,
        str(tmp_path),
        *(["--out", "x"] if command == "prepare" else []),
    ]
    paths = os.pathsep.join([str(tmp_path), *sys.path])
    done = subprocess.run(line, capture_output=True, text=True, env=os.environ | {"PYTHONPATH": paths})
    assert done.returncode == 2
    (error,) = done.stderr.splitlines()
    assert (
        error
        == f"error: pycolmap {version} is installed and has another interface; pip install 'pycolmap>=4.2,<5'"
    )
