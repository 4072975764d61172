"""Commands whose folder cannot be written, whose disk is full, or whose capture loses its images: they end
with one line and exit status 2, and leave no incomplete file.
"""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from neilfpp_method.cli import main
from neilfpp_method.data.files.images import write_exr
from neilfpp_method.settings.presets import PRESETS
from neilfpp_method.train import loop
from neilfpp_method.train.checkpoint import checkpoint_path, last_checkpoint
from tests.calls import refused, train_tiny, tree
from tests.hard_cases.faults.limits import largest_file, read_only
from tests.hard_cases.faults.whole_files import comparable_files
from tests.train.small_runs import differences, small_config

RUN, SKY, OTHER = "RUN", "SKY", "OTHER"
"""In the words of a command: a finished run, an environment map, and a copy of the run."""
SHORTEST = 1500
"""The least size of files, bytes; less would not hold the message, which pytest stores in a file."""
COMMANDS = {
    "eval": ("eval", RUN),
    "render": ("render", RUN, "--overwrite"),
    "export": ("export", RUN, "--what", "mesh", "light", "--resolution", "32"),
    "relight": ("relight", RUN, "--env", SKY, "--spp", "2", "--resolution", "32"),
    "turntable": (
        *("relight", RUN, "--env", SKY, "--spp", "2", "--resolution", "32"),
        *("--views", "turntable", "--frames", "3"),
    ),
    "report": ("report", RUN),
    "compare": ("compare", RUN, OTHER, "--out", f"{RUN}/compared", "--size", "64"),
}
"""Commands that write into the folder of a run."""


@pytest.fixture(scope="module")
def trained(tmp_path_factory, masked_capture) -> Path:
    return train_tiny(masked_capture, tmp_path_factory.mktemp("runs") / "sphere", "--no-report")


@pytest.fixture
def run(trained, tmp_path) -> Path:
    for name in ("run", "other"):
        shutil.copytree(trained, tmp_path / name)
    write_exr(tmp_path / "sky.exr", {"RGB": np.full((8, 16, 3), 0.5, np.float32)})
    return tmp_path / "run"


def words_of(name: str, run: Path) -> list[str]:
    places = {SKY: str(run.parent / "sky.exr"), OTHER: str(run.parent / "other")}
    return [places.get(word, word.replace(RUN, str(run))) for word in COMMANDS[name]]


@pytest.mark.parametrize("name", COMMANDS)
def test_a_run_that_cannot_be_written(run, capfd, name):
    with read_only(run):
        refused(capfd, words_of(name, run), str(run), leaves=run)


@pytest.mark.parametrize("resume", [False, True])
def test_a_training_whose_folder_cannot_be_written(run, capfd, masked_capture, resume):
    begin = ["train", "--data", str(masked_capture), "--out", str(run / "new"), "--device", "cpu"]
    words = ["train", "--resume", "--out", str(run), "--device", "cpu"] if resume else begin
    last_checkpoint(run).write_bytes(checkpoint_path(run, "sdf_init").read_bytes())
    with read_only(run):
        refused(capfd, words, str(run), leaves=run)


@pytest.mark.hard
@pytest.mark.parametrize("name", [name for name in COMMANDS if name != "eval"])  # its file is very small
def test_a_disk_that_is_full(run, capfd, name):
    """The limit is just below the size of the smallest, a middle, and the largest file that is written."""
    words, before = words_of(name, run), comparable_files(run)
    assert main(words) == 0
    whole = comparable_files(run)
    made = {key: (run / key).stat().st_size for key in whole if whole[key] != before.get(key)}
    # A surface that cannot be kept in the cache does not end a command.
    sizes = sorted({size for key, size in made.items() if size > SHORTEST and not key.startswith("cache")})
    assert sizes
    for size in sorted({sizes[0], sizes[len(sizes) // 2], sizes[-1]}):
        for key in made:
            (run / key).unlink(missing_ok=True)
        capfd.readouterr()
        with largest_file(size - 1):
            assert main(words) == 2, size
        said = capfd.readouterr().err
        assert said.count("\n") == 1, said
        assert said.startswith("error: ")
        assert "cannot be written" in said
        assert not [path for path in tree(run) if path.name.startswith(".")]
        left = comparable_files(run)
        assert {key: left[key] == whole[key] for key in left} == dict.fromkeys(left, True)
    assert main(words) == 0
    assert comparable_files(run) == whole


@pytest.mark.hard
def test_images_that_disappear_in_a_training(masked_capture, trained, tmp_path, monkeypatch, capfd):
    """The training ends with one line, and continues when the images are there again, bit for bit."""
    capture, review = tmp_path / "capture", loop.review_before_stage
    images, away = capture / "inputs" / "images", tmp_path / "away"
    shutil.copytree(masked_capture, capture)
    monkeypatch.setitem(PRESETS, "tiny", small_config)

    def lose_images(run, step: int) -> None:
        if step:
            images.rename(away)
        review(run, step)

    words = ["--out", str(tmp_path / "run"), "--device", "cpu", "--no-report"]
    with monkeypatch.context() as patch:
        patch.setattr(loop, "review_before_stage", lose_images)
        assert main(["train", "--data", str(capture), "--preset", "tiny", *words]) == 2
    said = capfd.readouterr().err
    assert said.count("\n") == 1
    assert said.startswith(f"error: {images}/000.exr: no such image; ")
    away.rename(images)
    assert main(["train", "--resume", *words]) == 0
    found, wanted = (
        torch.load(last_checkpoint(run), weights_only=True) for run in (tmp_path / "run", trained)
    )
    assert differences(found, wanted) == []
