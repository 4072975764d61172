"""Training with many pixels: the memory is bounded, and checked before it is allocated."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from neilfpp_method.cli import main
from neilfpp_method.data.capture import load_capture
from neilfpp_method.train.memory import training_bytes
from tests.data.large_capture import make_large_capture
from tests.data.make_capture import make_capture

ROOT = Path(__file__).parents[2]
MEASURE = """
import resource, sys
from tests.tiny_command import PRESETS, main, small_config
PRESETS["tiny"] = small_config
status = main(sys.argv[1:])
print("PEAK", resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024)
sys.exit(status)
"""


def peak(data: Path, out: Path) -> int:
    """Peak memory, bytes, of a process that trains on images at their full size."""
    command = [
        sys.executable,
        "-c",
        MEASURE,
        "train",
        "--data",
        str(data),
        "--preset",
        "tiny",
        "--device",
        "cpu",
    ]
    command += ["--scale", "1", "--test-every", "0", "--out", str(out)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return int(done.stdout.split("PEAK ")[1])


@pytest.mark.slow
def test_memory_is_that_of_single_views(tmp_path: Path) -> None:
    """48 views of 1 megapixel, which would need 0.9 GB at 19 bytes per pixel, need no more than a few views
    do.
    """
    small = peak(make_large_capture(tmp_path / "few", views=2, size=(1152, 864)), tmp_path / "a")
    large = peak(make_large_capture(tmp_path / "many", views=48, size=(1152, 864)), tmp_path / "b")
    pixels = 48 * 1152 * 864
    # 4 bytes a pixel are in files, of which pages stay mapped while they are read.
    assert large - small < 6 * pixels
    assert large - small < 19 * pixels / 3


def test_too_little_memory_is_an_error_of_one_line(tmp_path: Path, monkeypatch, capsys) -> None:
    root = make_capture(tmp_path / "c")
    monkeypatch.setattr("neilfpp_method.data.memory.available_memory", lambda: 2 * 10**8)
    assert main(["train", "--data", str(root), "--out", str(tmp_path / "run"), "--device", "cpu"]) == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert "to train on 5 views of up to 0.0 megapixels would need about" in told
    assert "0.2 GB are free; close other programs" in told
    assert not (tmp_path / "run").exists()


def test_the_estimate_grows_with_the_largest_image_and_hardly_with_their_number(tmp_path: Path) -> None:
    capture = load_capture(make_capture(tmp_path / "c"))
    many = training_bytes([capture.views[0]] * 300)
    assert many - training_bytes(capture.views) < 300 * 24 * 18
