"""Command lines and settings that are refused."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from tests.calls import refused
from tests.data.make_capture import make_capture


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["paint"], ("unknown command 'paint'", "train", "eval")),
        (["tran", "--data", "x"], ("unknown command 'tran'", "did you mean neilfpp train?")),
        (["train", "--dta", "x"], ("--dta", "did you mean --data?", "neilfpp train --help")),
        (
            ["train", "--data", "x", "--config.shading.specular", "False"],
            ("did you mean --config.shading.no-specular?",),
        ),
        (
            ["train", "--data", "x", "--config.shading.specular", "true"],
            ("did you mean --config.shading.specular?",),
        ),
        (["train", "--preset", "slow"], ("unknown preset 'slow'", "fast", "paper-ngp")),
        (["train", "--preset=slow"], ("unknown preset 'slow'",)),
        (["train", "--preset"], ("--preset", "neilfpp train --help")),
        (["train", "--data", "x", "--colour", "red"], ("--colour", "neilfpp train --help")),
        (["train", "--data", "x", "--config.train.rayss", "3"], ("did you mean --config.train.rays?",)),
        (["train", "--data", "x", "--config.train.rays", "few"], ("--config.train.rays", "'few'")),
        (["train", "--data", "x", "--host", "mesh", "--config.host.loss.mask", "1"], ("--config.host.loss",)),
        (["train", "--data", "x", "--config.loss.mask", "1"], ("did you mean --config.host.loss.mask?",)),
        (["train", "--response", "hdr"], ("--response", "linear", "srgb")),
        (["train", "--test-every", "often"], ("--test-every", "'often'")),
        (["train", "--config.train.rays", "1e3"], ("--config.train.rays: '1e3' is not a whole number",)),
        (["train", "--config.loss.volume", "x"], ("--config.loss.volume: 'x' is not a number",)),
        (["render", "a", "--width", "nan"], ("--width: 'nan' is not a whole number",)),
        (["relight", "a", "--rotate", "left"], ("--rotate: 'left' is not a number",)),
        (["relight", "a", "--box", "0", "1", "2"], ("--box: '0' '1' '2' is not 6 numbers",)),
        (["train"], ("--data",)),
        (["train", "--resume"], ("--resume needs the run's folder", "--out")),
        (["train", "teapot"], ("teapot", "did you mean --data teapot?", "neilfpp train --help")),
        (["eval"], ("missing: PATH (The run folder); see neilfpp eval --help",)),
        (
            ["prepare"],
            (
                "missing: PATH (Folder of photographs, with its sub-folders), ",
                ", --out PATH (Folder of the capture); ",
            ),
        ),
        (["eval", "a", "b"], ("b", "neilfpp eval --help")),
        (["export", "a", "--checkpoint", "first"], ("--checkpoint", "sdf_init")),
        (["render", "a", "--views", "best"], ("--views", "test")),
    ],
)
def test_a_command_line_that_makes_no_sense(tmp_path, monkeypatch, capfd, arguments, words):
    monkeypatch.chdir(tmp_path)
    refused(capfd, arguments, *words, leaves=tmp_path)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--config.train.rays", "0"], ("--config.train.rays is 0",)),
        (["--config.train.checkpoint-every", "0"], ("--config.train.checkpoint-every is 0",)),
        (["--config.train.joint-steps", "-1"], ("no steps",)),
        (["--config.loss.volume", "0"], ("--config.loss.volume",)),
        (["--devices", "0"], ("--devices",)),
        (["--device", "cuda:99"], ("no device 'cuda:99' here", "cpu")),
        (["--device", "abacus"], ("no device 'abacus' here", "cpu")),
        (["--device", "meta"], ("no device 'meta' here", "cpu")),
        (["--test-every", "1"], ("every 1-th view cannot be held out",)),
        (["--format", "tape"], ("unknown capture format 'tape'", "sfm_scene", "colmap")),
        (["--format", "colmap"], ("not a capture of the format colmap", "sparse/0")),
    ],
)
def test_settings_that_cannot_be(tmp_path, monkeypatch, capture, capfd, options, words):
    monkeypatch.chdir(tmp_path)
    command = ["train", "--data", capture, "--preset", "tiny", "--device", "cpu", *options]
    refused(capfd, command, *words, leaves=tmp_path)


@pytest.mark.parametrize("encoding", ["ascii", "cp1252"])
def test_an_output_of_another_encoding(tmp_path, encoding):
    """As of a terminal in another language, or of a file on Windows: they lack ×, −, and letters of names."""
    root = make_capture(tmp_path / "Größe 写真")
    command = [sys.executable, "-m", "neilfpp_method.cli", "inspect", str(root)]
    process = subprocess.run(
        command,
        capture_output=True,
        env={**os.environ, "PYTHONIOENCODING": encoding},
        timeout=60,
        check=False,
    )
    assert process.returncode == 0
    assert b"24" + "×".encode(encoding, "replace") + b"18" in process.stdout
    assert process.stderr == b""


@pytest.mark.parametrize("encoding", ["ascii", "UTF-8"])
def test_mistakes_are_one_line_in_any_encoding(encoding):
    """Tyro draws its boxes without their signs if the output is not called utf-8, in small letters."""
    said = []
    for arguments in (["eval"], ["eval", "run", "--protocl", "dtu"]):
        process = subprocess.run(
            [sys.executable, "-m", "neilfpp_method.cli", *arguments],
            capture_output=True,
            text=True,
            env={**os.environ, "PYTHONIOENCODING": encoding},
            timeout=60,
            check=False,
        )
        said.append(process.stderr)
    assert said == [
        "error: missing: PATH (The run folder); see neilfpp eval --help\n",
        "error: Unrecognized options: --protocl, dtu; did you mean --protocol? Otherwise see neilfpp eval "
        "--help\n",
    ]


def test_a_real_process_says_one_line_and_no_more(tmp_path):
    """No warning of a library before it, no traceback after it."""
    command = [sys.executable, "-m", "neilfpp_method.cli", "train", "--data", str(tmp_path / "nowhere")]
    process = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert process.returncode == 2
    assert process.stdout == ""
    assert process.stderr == f"error: {tmp_path / 'nowhere'}: no such folder; give the folder of a capture\n"
