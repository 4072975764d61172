"""Runs in processes of their own, through submitit: local processes, and Slurm as far as submitit's own
stand-in for it goes.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from neilfpp_method.cli import main
from neilfpp_method.data.capture import load_capture
from neilfpp_method.errors import UserError
from neilfpp_method.settings import presets
from neilfpp_method.tradeoff import submitted
from neilfpp_method.tradeoff.ending import Ending
from neilfpp_method.tradeoff.machines import parse_slurm, visible_gpu
from neilfpp_method.tradeoff.planned_runs import PlannedRun
from neilfpp_method.tradeoff.queue import work_through
from neilfpp_method.tradeoff.submitted import STOPPED, LocalProcesses, SlurmCluster, make_in_job
from neilfpp_method.train.budget_record import read_budget
from neilfpp_method.train.checkpoint import last_checkpoint, load_checkpoint
from neilfpp_method.train.json_files import read_json
from tests.data.make_capture import make_capture
from tests.train.small_runs import small_config
from tests.train.test_budget import STEPS

submitit = pytest.importorskip("submitit")
ROOT = Path(__file__).parents[2]


@pytest.fixture(autouse=True)
def at_root(monkeypatch: pytest.MonkeyPatch) -> None:
    """Other processes import this module."""
    monkeypatch.chdir(ROOT)


def planned(folder: Path, name: str = "1m-seed0") -> PlannedRun:
    return PlannedRun(folder / "no_capture", folder / name, small_config(), "auto", 60.0)


def stand_in(run: PlannedRun, device: str, report: object) -> Ending:
    """What a job sees; or it kills itself, or waits to be stopped."""
    if run.name == "killed":
        os.kill(os.getpid(), signal.SIGKILL)
    if run.name == "waits":
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        (run.out.parent / "waiting").touch()
        try:
            time.sleep(600)
        except KeyboardInterrupt:
            return Ending(STOPPED)
    return Ending(f"{device}, GPUs: {os.environ['CUDA_VISIBLE_DEVICES']}")


def boom(*_: object) -> Ending:
    raise ValueError("boom")


def crashes(run: PlannedRun, device: str, report: object) -> Ending:
    """A run with an error of the program."""
    submitted.attempt = boom
    return make_in_job(run, device, report)


def endings(engine: LocalProcesses, *runs: PlannedRun) -> dict[str, str]:
    ended = {}
    work_through(runs, engine, lambda text: None, lambda run, end: ended.update({run.name: end.left_out}))
    return ended


def test_each_process_sees_its_own_gpu(tmp_path, monkeypatch):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "2,5")
    engine = LocalProcesses(("cuda:0", "cuda:1"), tmp_path, None, stand_in)
    assert endings(engine, planned(tmp_path, "one"), planned(tmp_path, "two")) == {
        "one": "cuda, GPUs: 2",
        "two": "cuda, GPUs: 5",
    }


def test_a_failure_is_reported_with_its_cause(tmp_path, monkeypatch):
    """Bad input, with its message whole; an error of the program, and a killed process, with the log."""
    monkeypatch.setattr(submitit.LocalJob, "_results_timeout_s", 0)
    reports = {}
    for work, name in ((make_in_job, "refused"), (crashes, "crashed"), (stand_in, "killed")):
        reports |= endings(LocalProcesses(("cpu",), tmp_path, None, work), planned(tmp_path, name))
    with pytest.raises(UserError) as whole:
        load_capture(tmp_path / "no_capture")
    assert reports["refused"] == str(whole.value)
    cause, log = reports["crashed"].split("; see ")
    assert cause == "ValueError: boom"
    assert "in boom" in Path(log).read_text()
    assert "the process ended without a result" in reports["killed"]
    assert str(tmp_path / "jobs" / "killed") in reports["killed"]


def test_a_job_is_stopped_by_its_signal_only(tmp_path):
    """The terminal sends Ctrl-C to all processes; a job that is saving its state must not be killed by it."""
    job = LocalProcesses(("cpu",), tmp_path, None, stand_in).start(planned(tmp_path, "waits"), "cpu (0)")
    try:
        _wait_for(lambda: (tmp_path / "waiting").exists())
        os.kill(int(job._job.job_id), signal.SIGINT)
        time.sleep(2.0)
        assert not job.done()
    finally:
        job.stop()
        _wait_for(job.done)
    assert job.ending().left_out == STOPPED


def _wait_for(condition) -> None:
    deadline = time.monotonic() + 300
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.1)


def test_the_number_of_a_gpu_in_other_processes(monkeypatch):
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    assert visible_gpu("cuda:3") == 3
    for visible in ("GPU-1a2b", "7"):
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
        with pytest.raises(UserError, match=f"cuda:1: CUDA_VISIBLE_DEVICES is {visible}"):
            visible_gpu("cuda:1")


def test_parameters_of_slurm():
    text = "partition=gpu,gpus-per-node=1,mem_gb=7.5,exclusive=true,setup=module load cuda,time=90"
    assert parse_slurm(text) == {
        "partition": "gpu",
        "gpus_per_node": 1,
        "mem_gb": 7.5,
        "exclusive": True,
        "setup": ["module load cuda"],
        "time": 90,
    }


def test_a_job_of_slurm(tmp_path, monkeypatch):
    """The script for sbatch, and the result of the job, with submitit's stand-in for Slurm."""
    from submitit.core import submission
    from submitit.slurm.test_slurm import mocked_slurm

    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0")
    parameters = parse_slurm("partition=gpu,gpus_per_node=1,reservation=night,setup=module load cuda")
    with mocked_slurm() as slurm:
        engine = SlurmCluster(parameters, "auto", 2, tmp_path, None, stand_in)
        assert len(engine.places) == 2
        job = engine.start(planned(tmp_path), engine.places[0])
        script = next((tmp_path / "jobs" / "1m-seed0").glob("*submission*.sh")).read_text().splitlines()
        assert "#SBATCH --time=32" in script  # half more than a minute, and 30 minutes
        assert "#SBATCH --partition=gpu" in script
        assert "#SBATCH --gpus-per-node=1" in script
        assert "#SBATCH --reservation=night" in script
        assert "#SBATCH --job-name=1m-seed0" in script
        assert "module load cuda" in script
        assert not job.done()
        with slurm.job_context(job._job.job_id):
            submission.process_job(job._job.paths.folder)
        assert job.done()
        assert job.ending() == Ending("auto, GPUs: 0")

        cancelled = []
        other = engine.start(planned(tmp_path, "1m-seed1"), engine.places[1])
        monkeypatch.setattr(subprocess, "call", lambda command, **_: cancelled.append(command))
        other.stop()
        assert cancelled == [["scancel", other._job.job_id]]
        assert other.done()

        with pytest.raises(UserError, match="the job was not submitted"):
            SlurmCluster({"mem_gb": "much"}, "auto", 1, tmp_path, None).start(planned(tmp_path), "")


@pytest.mark.parametrize("options", [["--device", "cpu,cpu"], ["--slurm", "partition=gpu"]])
def test_without_submitit_there_is_a_remedy(sphere_capture, tmp_path, monkeypatch, capsys, options):
    monkeypatch.setitem(sys.modules, "submitit", None)
    words = ["tradeoff", "--data", str(sphere_capture), "--out", str(tmp_path / "out"), *options]
    assert main(words) == 2
    error = capsys.readouterr().err
    assert "pip install 'neilfpp-method[cluster]'" in error
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_submitit_is_not_imported_unless_it_is_used():
    asks = "import sys, neilfpp_method.tradeoff.command; sys.exit('submitit' in sys.modules)"
    subprocess.run([sys.executable, "-c", asks], timeout=300, check=True)


@pytest.mark.slow
def test_two_runs_at_a_time_are_stopped_and_continued(tmp_path, monkeypatch, capsys):
    """Ctrl-C stops both processes, which save their state; the next call continues both to their end."""
    config = small_config(**STEPS)
    monkeypatch.setitem(presets.PRESETS, "fast", lambda: config)
    capture, out = make_capture(tmp_path / "sphere", size=(48, 36), masks=True), tmp_path / "out"
    words = ["tradeoff", "--data", str(capture), "--out", str(out), "--device", "cpu,cpu"]
    words += ["--budgets", "4m", "--seeds", "2"]
    folders = [out / f"4m-seed{seed}" for seed in (0, 1)]

    def press_ctrl_c() -> None:
        _wait_for(lambda: all((folder / "capture.json").exists() for folder in folders))
        os.kill(os.getpid(), signal.SIGINT)

    presser = threading.Thread(target=press_ctrl_c)
    presser.start()
    assert main(words) == 130
    presser.join()
    assert "runs in training save their state" in capsys.readouterr().out
    trained = []
    for folder in folders:
        assert read_budget(folder).took is None
        trained.append(load_checkpoint(last_checkpoint(folder))["step"])
    assert main(words) == 0
    said = capsys.readouterr().out
    assert "run 1 of 2: 4m-seed0 on cpu (0)" in said
    assert "4m-seed1 finished" in said
    assert len(read_json(out / "tradeoff.json")["runs"]) == 2
    for folder, steps in zip(folders, trained, strict=True):
        assert load_checkpoint(last_checkpoint(folder))["step"] > steps
