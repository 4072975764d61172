"""A run that is stopped and continued agrees bit for bit with an uninterrupted run."""

from __future__ import annotations

import errno
import itertools
import json
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import BinaryIO

import pytest
import torch
from rich.console import Console

from neilfpp_method.cli import main
from neilfpp_method.effects.request import parse_effects
from neilfpp_method.errors import Stopped, UserError
from neilfpp_method.settings.types import NeilfConfig
from neilfpp_method.train import loop
from neilfpp_method.train.checkpoint import LAST, checkpoint_path, last_checkpoint
from neilfpp_method.train.command import run_training
from neilfpp_method.train.request import TrainingRequest
from neilfpp_method.train.run import load_run, read_description
from tests.data.make_capture import make_capture
from tests.train.small_runs import differences, short_light_fits, small_config, solved_light

# Four steps in each of three stages: 0–3, 4–7, 8–11.
STEPS = 12


def run(
    data: Path | None, out: Path, config: NeilfConfig | None = None, resume: bool = False, **options
) -> str:
    """Train or continue, and return the printed messages."""
    console = Console()
    with console.capture() as said:
        run_training(TrainingRequest(data, out, config, resume, device="cpu", **options), console)
    return said.get()


def interrupt_at(patch: pytest.MonkeyPatch, *steps: int) -> None:
    """Press Ctrl-C while these steps are computed."""

    def seed_step(seed: int, step: int, rank: int = 0) -> None:
        if step in steps:
            signal.raise_signal(signal.SIGINT)
        original(seed, step, rank)

    original = loop.seed_step
    patch.setattr(loop, "seed_step", seed_step)


def state(out: Path, name: str = LAST) -> dict:
    return torch.load(checkpoint_path(out, name), weights_only=True)


def files(folder: Path) -> dict[Path, tuple[int, bytes]]:
    """Everything in a folder, with its time and contents."""
    return {
        path: (path.stat().st_mtime_ns, path.read_bytes()) for path in folder.rglob("*") if path.is_file()
    }


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory, capture: Path) -> Path:
    """An uninterrupted run."""
    out = tmp_path_factory.mktemp("runs") / "whole"
    run(capture, out, small_config())
    return out


# `test_many_stops_change_nothing` also stops in the steps of the slow cases, or in the one after.
@pytest.mark.parametrize(
    ("asked", "stops"),
    [
        *[(0, 1), (2, 3), (4, 5), (10, 11), (3, 5), (7, 9)],
        *[pytest.param(*case, marks=pytest.mark.slow) for case in ((1, 2), (6, 7), (8, 9))],
    ],
    ids=lambda value: str(value),
)
def test_a_stop_in_any_stage_changes_nothing(tmp_path, capture, whole, monkeypatch, asked, stops):
    out = tmp_path / "run"
    with monkeypatch.context() as patch:
        interrupt_at(patch, asked)
        with pytest.raises(Stopped, match=f"stopped after step {stops}; continue with: neilfpp train"):
            run(capture, out, small_config())
    assert state(out)["step"] == stops
    run(None, out, resume=True)
    assert state(out)["step"] == STEPS
    for name in (LAST, "sdf_init", "material_init", "joint"):
        assert differences(state(out, name), state(whole, name)) == []
    for stage in ("sdf_init", "material_init", "joint"):
        preview = Path("previews") / f"{stage}.png"
        assert (out / preview).read_bytes() == (whole / preview).read_bytes()


def test_the_comparison_detects_a_changed_bit(whole):
    changed = state(whole)
    moments = changed["optimizer"]["state"]
    assert {"exp_avg", "exp_avg_sq", "step"} <= moments[0].keys()
    entry = moments[0]["exp_avg_sq"].view(-1)[-1:]
    entry.copy_(entry.nextafter(torch.ones(1)))
    assert differences(state(whole), changed) == [".optimizer.state.0.exp_avg_sq"]


def test_many_stops_change_nothing(tmp_path, capture, whole, monkeypatch):
    out = tmp_path / "run"
    with monkeypatch.context() as patch:
        interrupt_at(patch, 1, 5, 6, 9)
        for resume in (False, True, True, True):
            with pytest.raises(Stopped):
                run(None if resume else capture, out, None if resume else small_config(), resume=resume)
    run(None, out, resume=True)
    assert differences(state(out), state(whole)) == []


def test_a_killed_run_continues_from_its_last_checkpoint(tmp_path, capture, whole, monkeypatch):
    """Nothing is saved when the process is killed; the last checkpoint, made every third step, exists."""

    def die(seed: int, step: int, rank: int = 0) -> None:
        if step == 7:
            raise MemoryError
        original(seed, step, rank)

    original, out = loop.seed_step, tmp_path / "run"
    with monkeypatch.context() as patch:
        patch.setattr(loop, "seed_step", die)
        with pytest.raises(MemoryError):
            run(capture, out, small_config())
    assert state(out)["step"] == 6
    run(None, out, resume=True)
    assert differences(state(out), state(whole)) == []


def test_a_run_on_a_full_disk_continues_when_there_is_space(tmp_path, capture, whole, monkeypatch):
    """The disk is full when the checkpoint after step 6 is due."""

    def save(contents: dict, file: BinaryIO) -> None:
        if contents["step"] == 6:
            raise OSError(errno.ENOSPC, "No space left on device")
        write(contents, file)

    write, out = torch.save, tmp_path / "run"
    with monkeypatch.context() as patch:
        patch.setattr(torch, "save", save)
        with pytest.raises(
            UserError, match=r"last\.pt: cannot be written \(No space .*; make room, and continue with: "
        ):
            run(capture, out, small_config())
    assert state(out)["step"] == 4
    assert not [path for path in last_checkpoint(out).parent.iterdir() if path.name.startswith(".")]
    run(None, out, resume=True)
    assert differences(state(out), state(whole)) == []


def test_a_stop_in_the_last_step_has_no_effect(tmp_path, capture, whole, monkeypatch):
    interrupt_at(monkeypatch, STEPS - 1)
    run(capture, tmp_path / "run", small_config())
    assert differences(state(tmp_path / "run"), state(whole)) == []


def test_random_numbers_differ_by_seed_step_and_process():
    def drawn(*place: int) -> float:
        loop.seed_step(*place)
        return torch.rand(()).item()

    places = list(itertools.product((0, 1), (0, 1, 2, 1000), (0, 1)))
    assert len({drawn(*place) for place in places}) == len(places)
    assert drawn(1, 2, 0) == drawn(1, 2, 0)


def test_a_second_ctrl_c_does_not_wait(tmp_path, capture, whole, monkeypatch):
    """The steps since the last checkpoint are lost and computed again."""

    def seed_step(seed: int, step: int, rank: int = 0) -> None:
        if step == 5:
            signal.raise_signal(signal.SIGINT)
            signal.raise_signal(signal.SIGINT)
        original(seed, step, rank)

    original, out = loop.seed_step, tmp_path / "run"
    with monkeypatch.context() as patch:
        patch.setattr(loop, "seed_step", seed_step)
        with pytest.raises(Stopped, match="stopped at once; continue from the last checkpoint with: neilfpp"):
            run(capture, out, small_config())
    assert state(out)["step"] == 4
    run(None, out, resume=True)
    assert differences(state(out), state(whole)) == []


def test_time_adds_up_over_stops(tmp_path, capture, monkeypatch):
    """With a clock that advances when it is read, a stage takes one second per step, stopped or not."""
    out = tmp_path / "run"
    with monkeypatch.context() as patch:
        patch.setattr(loop, "time", SimpleNamespace(perf_counter=ticking()))  # only in the loop
        interrupt_at(patch, 1, 5)
        with pytest.raises(Stopped):
            run(capture, out, small_config())
        assert json.loads((out / "timing.json").read_text()) == {"sdf_init": 2.0}
        with pytest.raises(Stopped):
            run(None, out, resume=True)
        assert json.loads((out / "timing.json").read_text()) == {"sdf_init": 4.0, "material_init": 2.0}
        run(None, out, resume=True)
    assert json.loads((out / "timing.json").read_text()) == {
        "sdf_init": 4.0,
        "material_init": 4.0,
        "joint": 4.0,
    }


def ticking() -> Callable[[], float]:
    count = itertools.count()
    return lambda: float(next(count))


# ------------------------------------------------------------------------------------------ what resume takes


def test_a_finished_run_is_unchanged(whole):
    before = files(whole)
    said = run(None, whole, resume=True)
    assert said == f"run folder {whole}: finished already, nothing to continue\n"
    assert files(whole) == before


def test_loading_a_run_that_is_not_finished_says_so(tmp_path, capture, whole, monkeypatch, caplog):
    out = tmp_path / "run"
    with monkeypatch.context() as patch:
        interrupt_at(patch, 6)
        with pytest.raises(Stopped):
            run(capture, out, small_config())
    load_run(whole)
    load_run(out, checkpoint="sdf_init")
    assert caplog.messages == []
    load_run(out)
    told = f"{out}: trained for 7 of {STEPS} steps; continue with: neilfpp train --out {out} --resume"
    assert caplog.messages == [told]


def test_a_run_keeps_its_settings(tmp_path, capture, whole, monkeypatch):
    out = tmp_path / "run"
    with monkeypatch.context() as patch:
        interrupt_at(patch, 5)
        with pytest.raises(Stopped):
            run(capture, out, small_config())
    before = files(out)
    other = make_capture(tmp_path / "other")
    for given in (
        {"data": None, "config": small_config(rays=49)},
        {"data": other},
        {"data": None, "test_every": 3},
        {"data": None, "response": "srgb"},
    ):
        with pytest.raises(UserError, match="a run keeps its capture and its settings"):
            run(out=out, resume=True, **given)
    assert files(out) == before
    run(capture, out, small_config(), resume=True)  # the same command with --resume is accepted
    assert read_description(out) == read_description(whole)
    assert differences(state(out), state(whole)) == []


def test_a_run_that_stopped_before_its_first_checkpoint_starts_again(tmp_path, capture, whole, monkeypatch):
    out = tmp_path / "run"
    with monkeypatch.context() as patch:
        patch.setattr("neilfpp_method.train.command.train", lambda training: None)
        run(capture, out, small_config())
    assert not last_checkpoint(out).parent.exists()
    run(None, out, resume=True)
    assert differences(state(out), state(whole)) == []


def test_weights_that_do_not_fit_the_settings_are_refused(tmp_path, capture, monkeypatch):
    out = tmp_path / "run"
    interrupt_at(monkeypatch, 1)
    with pytest.raises(Stopped):
        run(capture, out, small_config())
    settings = json.loads((out / "config.json").read_text())
    settings["config"]["brdf"]["width"] += 1
    (out / "config.json").write_text(json.dumps(settings))
    with pytest.raises(UserError, match=r"does not fit the settings in config\.json"):
        run(None, out, resume=True)


# ---------------------------------------------------------------------------------------------- a real Ctrl-C


@pytest.mark.slow
def test_ctrl_c_in_a_real_terminal_session(tmp_path, capture):
    """The process prints in one line how to continue and ends with 130; that line, typed unchanged, continues
    the run.
    """
    out, rays = tmp_path / "a folder with spaces", 512
    command = [
        sys.executable,
        "-m",
        "tests.tiny_command",
        "train",
        "--data",
        str(capture),
        "--preset",
        "tiny",
    ]
    command += ["--config.train.rays", str(rays), "--device", "cpu", "--out"]
    process = _start([*command, str(out)])
    while not last_checkpoint(out).exists():
        assert process.poll() is None
        time.sleep(0.005)
    process.send_signal(signal.SIGINT)
    _, complaint = process.communicate(timeout=60)
    assert process.returncode == 130
    stopped = state(out)["step"]
    assert 3 <= stopped < STEPS
    told = f"stopped after step {stopped}; continue with: neilfpp train --out '{out}' --resume --device cpu\n"
    assert complaint == told

    assert main(shlex.split(complaint.split("continue with: neilfpp ")[1])) == 0
    # Also run in a separate process: commands flush denormal numbers, which the moments of a table
    # may contain.
    unstopped = _start([*command, str(tmp_path / "unstopped")])
    unstopped.communicate(timeout=60)
    assert unstopped.returncode == 0
    assert differences(state(out), state(tmp_path / "unstopped")) == []


def _start(command: list[str]) -> subprocess.Popen[str]:
    pipes = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen(command, cwd=Path(__file__).parents[2], **pipes)


# ---------------------------------------------------------------------------------------------------- effects


@short_light_fits()
def test_decisions_by_evidence_are_read_from_the_run(tmp_path, capture, monkeypatch):
    """A stopped run decides as an uninterrupted one, and a loaded run has the settings that follow."""
    config = solved_light(small_config())
    asked = parse_effects("auto")
    run(capture, tmp_path / "whole", config, effects=asked)
    with monkeypatch.context() as patch:
        interrupt_at(patch, 2, 6)
        for resume in (False, True):
            with pytest.raises(Stopped):
                run(
                    None if resume else capture,
                    tmp_path / "run",
                    None if resume else config,
                    resume=resume,
                    effects=asked,
                )
    run(None, tmp_path / "run", resume=True)
    assert differences(state(tmp_path / "run"), state(tmp_path / "whole")) == []
    records = [json.loads((tmp_path / name / "effects.json").read_text()) for name in ("run", "whole")]
    assert records[0] == records[1]
    decided = [entry for entry in records[0]["decisions"] if entry["effect"] == "inter-reflection"]
    assert [entry["step"] for entry in decided] == [4, 8]
    loaded = load_run(tmp_path / "run")
    assert (loaded.config.light.inter_reflection == "off") == (not decided[-1]["on"])
    assert loaded.model.config == loaded.config
    with pytest.raises(UserError, match="its effects are 'auto'"):
        run(None, tmp_path / "run", resume=True, effects=parse_effects("none"))
