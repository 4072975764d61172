"""The five commands of docs/blender.md, run one after the other on photographs of a corner.

Options are added that make them short: few steps, few texels. The last command needs Blender, or a Python
with bpy (NEILFPP_BPY); without one, only the presence of the script is checked.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest

from neilfpp_method.cli import main
from neilfpp_method.data.files.images import read_image
from neilfpp_method.settings.presets import PRESETS
from tests.prepare.textured_corner import make_photos
from tests.train.small_runs import small_config, solved_light

PAGE = Path(__file__).parent.parent / "docs" / "blender.md"
SHORT = {
    "train": ["--preset", "tiny", "--device", "cpu"],
    "export": ["--texture-size", "128", "--faces", "400", "--resolution", "32", "--device", "cpu"],
}


def commands() -> list[list[str]]:
    """The words of each line of the first block of the page."""
    block = re.search(r"```sh\n(.*?)```", PAGE.read_text("utf-8"), re.DOTALL)
    assert block is not None
    return [shlex.split(line, comments=True) for line in block[1].splitlines()]


def test_there_are_five():
    lines = commands()
    assert [words[0] for words in lines] == 4 * ["neilfpp"] + ["blender"]
    assert [words[1] for words in lines[:4]] == ["prepare", "inspect", "train", "export"]


@pytest.mark.slow
def test_from_photographs_to_blender(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(PRESETS, "tiny", lambda: solved_light(small_config(sdf_steps=2, material_steps=3)))
    make_photos(Path("photos/teapot"), views=9)
    *ours, blender = commands()
    for words in ours:
        assert main([*words[1:], *SHORT.get(words[1], [])]) == 0, shlex.join(words)
    script = Path(blender[-1])
    assert script.is_file()
    rendered = opened(script)
    if rendered is None:
        pytest.skip("four of five commands ran; the fifth needs Blender, or NEILFPP_BPY")
    assert rendered.shape == (90, 120, 3)
    assert rendered.std() > 0


def opened(script: Path):
    """The first view of the scene that the script opens, rendered by Blender, linear; None without
    Blender.
    """
    words = ["--camera", "000", "--render", "000.exr", "--percent", "50", "--samples", "2"]
    if python := os.environ.get("NEILFPP_BPY"):
        program = [python, str(script)]
    elif shutil.which("blender"):
        program = ["blender", "--background", "--python", str(script), "--"]
    else:
        return None
    done = subprocess.run([*program, *words], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    return read_image(Path("000.exr")).pixels
