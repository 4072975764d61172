"""The run folder: complete files or none, no code from a file is run, and invalid files are refused in one
line.
"""

from __future__ import annotations

import errno
import json
import math
import os
import platform
from importlib import metadata
from pathlib import Path
from typing import BinaryIO

import numpy as np
import pytest
import torch

from neilfpp_method.data.capture import load_capture
from neilfpp_method.errors import UserError
from neilfpp_method.lighting.solver import NothingToSolve
from neilfpp_method.settings.facts import SceneFacts
from neilfpp_method.train.checkpoint import last_checkpoint, load_checkpoint, save_checkpoint
from neilfpp_method.train.run import FORMAT, CaptureSource, check_free, create_run, load_run, read_description
from tests.calls import train_tiny
from tests.data.make_capture import make_capture
from tests.scenes import tiny_config
from tests.train.small_runs import few_steps

FACTS = SceneFacts("linear", 0.25, 3.0, "constant", (0.5, 0.25, 0.125))


def learner() -> tuple[torch.nn.Module, torch.nn.Module, torch.optim.Optimizer]:
    """A model, a light solver without memory, and the optimizer after one step."""
    model = torch.nn.Linear(3, 2)
    optimizer = torch.optim.Adam(model.parameters())
    model(torch.ones(1, 3)).sum().backward()
    optimizer.step()
    return model, NothingToSolve(), optimizer


def refused(path: Path, complaint: str) -> None:
    with pytest.raises(UserError, match=complaint) as caught:
        load_checkpoint(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)
    assert caught.value.remedy


# ------------------------------------------------------------------------------------------------ checkpoints


def test_a_checkpoint_is_read_back(tmp_path):
    model, solver, optimizer = learner()
    save_checkpoint(last_checkpoint(tmp_path), model, solver, optimizer, 7)
    saved = load_checkpoint(last_checkpoint(tmp_path))
    assert saved["step"] == 7
    torch.testing.assert_close(saved["model"], model.state_dict(), rtol=0, atol=0)
    other_model, _, other = learner()
    other_model.load_state_dict(saved["model"])
    other.load_state_dict(saved["optimizer"])
    torch.testing.assert_close(other.state_dict(), optimizer.state_dict(), rtol=0, atol=0)


def test_a_crash_while_writing_leaves_the_old_checkpoint(tmp_path, monkeypatch):
    path = tmp_path / "last.pt"
    save_checkpoint(path, *learner(), 7)
    before = path.read_bytes()

    def half_a_save(contents: object, file: BinaryIO) -> None:
        file.write(before[: len(before) // 2])
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(torch, "save", half_a_save)
    with pytest.raises(
        UserError, match=r"last\.pt: cannot be written \(No space left on device\); make room"
    ):
        save_checkpoint(path, *learner(), 8)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


class Bomb:
    """An object that creates a file when it is unpickled."""

    def __init__(self, crater: Path) -> None:
        self.crater = crater

    def __reduce__(self):
        return Path.touch, (self.crater,)


def test_a_checkpoint_with_code_is_refused_without_running_it(tmp_path):
    path, crater = tmp_path / "last.pt", tmp_path / "crater"
    torch.save({"format": FORMAT, "step": 1, "model": Bomb(crater), "optimizer": {}}, path)
    refused(path, "not a readable checkpoint")
    assert not crater.exists()
    torch.load(path, weights_only=False)
    assert crater.exists()  # pickle itself runs the code


def test_a_truncated_checkpoint(tmp_path):
    path = tmp_path / "last.pt"
    save_checkpoint(path, *learner(), 7)
    whole = path.read_bytes()
    for length in (0, 1, 10, 100, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:length])
        refused(path, "not a readable checkpoint")


def test_a_damaged_checkpoint_is_read_or_refused(tmp_path):
    path = tmp_path / "last.pt"
    save_checkpoint(path, *learner(), 7)
    whole = path.read_bytes()
    generator = torch.Generator().manual_seed(0)
    for _ in range(200):
        damaged = bytearray(whole)
        for place in torch.randint(len(whole), (20,), generator=generator).tolist():
            damaged[place] = int(torch.randint(256, (), generator=generator))
        path.write_bytes(damaged)
        try:
            load_checkpoint(path)
        except UserError:
            continue


def test_a_missing_checkpoint(tmp_path):
    refused(tmp_path / "last.pt", "no checkpoint")
    (tmp_path / "joint.pt").mkdir()
    refused(tmp_path / "joint.pt", "no checkpoint")


@pytest.mark.parametrize(
    "contents",
    [
        {"format": FORMAT + 1, "step": 1, "model": {}, "optimizer": {}},
        {"step": 1, "model": {}, "optimizer": {}},
        {"format": FORMAT, "step": 1},
        {"weight": torch.zeros(3)},
        [FORMAT],
        torch.zeros(3),
    ],
)
def test_a_checkpoint_of_another_version(tmp_path, contents):
    torch.save(contents, tmp_path / "last.pt")
    refused(tmp_path / "last.pt", "a checkpoint of another version")


# ----------------------------------------------------------------------------------------------- descriptions


def described(path: Path) -> Path:
    create_run(path, tiny_config(), CaptureSource("/captures/sphere", 4, "linear", "sfm_scene"), FACTS)
    return path


def test_a_description_is_read_back(tmp_path):
    run = read_description(described(tmp_path / "run"))
    assert run.config == tiny_config()
    assert run.source == CaptureSource("/captures/sphere", 4, "linear", "sfm_scene")
    assert run.facts == FACTS


def test_a_run_keeps_its_scene_frame(tmp_path):
    """Fields are functions of the scene frame; masks or points that are added later may change the box."""
    root = make_capture(tmp_path / "capture")
    run = train_tiny(root, tmp_path / "run", config=few_steps)
    before = load_capture(root).normalization
    change(root / "inputs" / "sfm_scene.json", bbox={"transform": np.diag([9.0, 9, 9, 1]).tolist()})
    assert load_capture(root).normalization != before
    assert load_run(run).capture.normalization == before


def test_a_run_is_not_created_in_a_folder_with_other_files(tmp_path):
    (tmp_path / "empty").mkdir()
    check_free(tmp_path / "empty")
    check_free(tmp_path / "missing")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.tex").write_text("Abstract")
    (tmp_path / "file").write_text("")
    for name, complaint in (("full", "exists already; choose another --out"), ("file", "is a file; name a")):
        with pytest.raises(UserError, match=f"{name}: {complaint}"):
            described(tmp_path / name)
    assert [path.name for path in (tmp_path / "full").iterdir()] == ["thesis.tex"]


def test_a_full_disk_leaves_no_part_of_a_description(tmp_path, monkeypatch):
    """The same command can then be given again."""

    def full(source: Path, target: Path) -> None:
        if Path(target).name == "config.json":
            raise OSError(errno.ENOSPC, "No space left on device")
        rename(source, target)

    rename = os.replace
    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(UserError, match=r"config\.json: cannot be written"):
        described(tmp_path / "run")
    assert list((tmp_path / "run").iterdir()) == []
    monkeypatch.undo()
    described(tmp_path / "run")


def change(path: Path, **values) -> None:
    contents = json.loads(path.read_text()) | values
    path.write_text(json.dumps(contents))


@pytest.mark.parametrize(
    ("file", "values", "complaint"),
    [
        (
            "config.json",
            {"format": FORMAT + 1},
            f"written in run format {FORMAT + 1}, this version reads {FORMAT}",
        ),
        ("config.json", {"format": None}, "written in run format None"),
        (
            "config.json",
            {"config": {"telepathy": True}},
            r"config\.json: config: unknown setting 'telepathy'",
        ),
        (
            "config.json",
            {"config": {"encoding": {"kind": "hush"}}},
            r"config\.encoding\.kind: 'hush' is not a choice",
        ),
        ("config.json", {"config": None}, "not a complete description"),
        ("config.json", {"config": {"brdf": 3}}, "config.brdf: 3 where settings belong"),
        ("capture.json", {"drive": "B:"}, r"capture\.json: unknown setting 'drive'"),
        ("capture.json", {"response": "log"}, r"capture\.json\.response: 'log' is not a choice"),
        ("capture.json", {"unit": 0.0, "center": [0.0, 0.0, 0.0]}, r"capture\.json: unit is not positive"),
        (
            "capture.json",
            {"unit": math.nan, "center": [0.0, 0.0, 0.0]},
            r"capture\.json: unit is not positive",
        ),
        (
            "capture.json",
            {"unit": 1.0, "center": [0.0, 0.0, math.inf]},
            r"capture\.json: .* center not finite",
        ),
        ("capture.json", {"unit": 1.0}, r"capture\.json: only one of unit and center is given"),
        ("scene.json", {"moon": 1}, r"scene\.json: unknown setting 'moon'"),
    ],
)
def test_a_description_of_another_version(tmp_path, file, values, complaint):
    change(described(tmp_path / "run") / file, **values)
    with pytest.raises(UserError, match=complaint):
        read_description(tmp_path / "run")


@pytest.mark.parametrize("file", ["config.json", "capture.json", "scene.json"])
@pytest.mark.parametrize("text", [None, b"", b"{", b"[]", b"{}", b"\xff"])
def test_a_damaged_description(tmp_path, file, text):
    path = described(tmp_path / "run") / file
    path.unlink() if text is None else path.write_bytes(text)
    with pytest.raises(UserError, match=file) as caught:
        read_description(tmp_path / "run")
    assert caught.value.remedy


def test_a_folder_that_is_no_run(tmp_path):
    with pytest.raises(UserError, match="no run here"):
        load_run(tmp_path)


def test_the_environment_is_recorded(tmp_path):
    written = json.loads((described(tmp_path / "run") / "environment.json").read_text())
    assert written["packages"]["torch"] == metadata.version("torch")
    assert written["packages"]["numpy"] == metadata.version("numpy")
    assert written["python"] == platform.python_version()
    assert written["cores"] >= 1
    assert written["threads"] == torch.get_num_threads()
    assert written["processor"]
    assert len(written["gpus"]) == torch.cuda.device_count()
    assert written["command"]
