"""Two processes train one model: each on its own rays, both with the mean of the gradients."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
import torch

from neilfpp_method.cli import main
from neilfpp_method.data.capture import load_capture
from neilfpp_method.schedule import Stage, active_losses, weigh
from neilfpp_method.settings.presets import PRESETS
from neilfpp_method.train.checkpoint import last_checkpoint
from neilfpp_method.train.optimizer import seed_step
from tests.coarse_hulls import start_geometry
from tests.train.small_runs import differences, small_config, small_training

REPOSITORY = Path(__file__).parents[2]
STEPS = [
    "--config.train.sdf-steps",
    "2",
    "--config.train.material-steps",
    "2",
    "--config.train.joint-steps",
    "2",
]


@contextmanager
def started(
    capture: Path, out: Path, *options: str, record: Path | None = None
) -> Iterator[subprocess.Popen]:
    """Start a training in two processes; both are ended when the context ends."""
    command = [sys.executable, "-m", "tests.tiny_command", "train", "--data", str(capture), "--out", str(out)]
    command += ["--preset", "tiny", "--device", "cpu", "--devices", "2", *options]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"} | ({"TINY_RECORD": str(record)} if record else {})
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    process = subprocess.Popen(command, env=environment, cwd=REPOSITORY, start_new_session=True, **pipes)
    try:
        yield process
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


def recorded(folder: Path, name: str) -> dict[str, torch.Tensor]:
    """The values that a process has written; the second process may end slightly after the first."""
    path, deadline = folder / f"{name}.pt", time.monotonic() + 20.0
    while time.monotonic() < deadline:
        try:
            return torch.load(path, weights_only=True)
        except (OSError, RuntimeError, EOFError):
            time.sleep(0.05)
    raise AssertionError(f"{path} was not written")


def test_two_processes_end_with_one_model(tmp_path, capture):
    """Two steps of each stage."""
    out = tmp_path / "run"
    with started(capture, out, *STEPS, record=tmp_path) as process:
        said, complaint = process.communicate(timeout=120)
    assert process.returncode == 0, complaint
    assert said.count("run folder") == 1

    first, second = (recorded(tmp_path, f"parameters_{rank}") for rank in (0, 1))
    assert differences(first, second) == []
    saved = torch.load(last_checkpoint(out), weights_only=True)
    assert saved["step"] == 6
    assert differences({name: saved["model"][name] for name in first}, first) == []

    # The first step, computed here for both processes one after the other.
    config = small_config(sdf_steps=2, material_steps=2, joint_steps=2)
    model_of = small_training(capture, tmp_path / "here", config)
    start_geometry(model_of.model, load_capture(capture), config)
    gradients = [local_gradients(model_of, rank) for rank in (0, 1)]
    seen = [recorded(tmp_path, f"gradients_{rank}") for rank in (0, 1)]
    assert differences(*seen) == []
    assert seen[0].keys() == gradients[0].keys()
    for name, gradient in seen[0].items():
        torch.testing.assert_close(
            gradient, (gradients[0][name] + gradients[1][name]) / 2.0, rtol=1e-4, atol=1e-7
        )
    apart = [
        (gradients[0][name] - gradients[1][name]).norm() > 0.1 * seen[0][name].norm() for name in seen[0]
    ]
    assert sum(apart) > 0.8 * len(apart)  # other rays


def local_gradients(training, rank: int) -> dict[str, torch.Tensor]:
    """The gradient of step 0 on the rays of one process."""
    model, stage = training.model.train(), Stage.SDF_INIT
    model.freeze_for(stage)
    seed_step(training.config.train.seed, 0, rank)
    terms = model.losses(training.pixels.sample(training.config.train.rays), stage)
    weigh(terms, active_losses(stage, training.config)).loss.backward()
    return {name: p.grad.clone() for name, p in model.named_parameters() if p.grad is not None}


def test_a_stop_ends_both_processes_after_the_same_step(tmp_path, capture):
    """Only the first process receives the signal."""
    out = tmp_path / "run"
    with started(capture, out, "--config.train.sdf-steps", "100000") as process:
        while not last_checkpoint(out).exists():
            assert process.poll() is None
            time.sleep(0.02)
        process.send_signal(signal.SIGINT)
        _, complaint = process.communicate(timeout=30)  # until both processes have ended
    assert process.returncode == 130
    assert complaint.count("stopped after step") == 1
    assert complaint.endswith(f"continue with: neilfpp train --out {out} --resume --device cpu --devices 2\n")


@pytest.mark.slow
def test_two_nodes_end_with_one_model(tmp_path, capture):
    """torchrun starts one process for each of two nodes, here on one machine."""
    out, port = tmp_path / "run", free_port()
    train = [
        "train",
        "--data",
        str(capture),
        "--out",
        str(out),
        "--preset",
        "tiny",
        "--device",
        "cpu",
        *STEPS,
    ]
    nodes = []
    for rank in range(2):
        records = tmp_path / f"node{rank}"
        records.mkdir()
        torchrun = [sys.executable, "-m", "torch.distributed.run", "--nnodes", "2", "--node-rank", str(rank)]
        torchrun += ["--master-addr", "127.0.0.1", "--master-port", str(port), "--nproc-per-node", "1"]
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "TINY_RECORD": str(records)}
        command = [*torchrun, "-m", "tests.tiny_command", *train, "--nodes", "2"]
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        nodes.append(
            subprocess.Popen(command, env=environment, cwd=REPOSITORY, start_new_session=True, **pipes)
        )
    try:
        said = [node.communicate(timeout=240) for node in nodes]
    finally:
        for node in nodes:
            with suppress(ProcessLookupError):
                os.killpg(node.pid, signal.SIGKILL)
    assert [node.returncode for node in nodes] == [0, 0], said
    assert sum(words.count("run folder") for words, _ in said) == 1
    first, second = (recorded(tmp_path / f"node{rank}", "parameters_0") for rank in range(2))
    assert differences(first, second) == []
    seen = [recorded(tmp_path / f"node{rank}", "gradients_0") for rank in range(2)]
    assert differences(*seen) == []
    assert torch.load(last_checkpoint(out), weights_only=True)["step"] == 6


def free_port() -> int:
    """A port of this machine that is not in use."""
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        return server.getsockname()[1]


@pytest.mark.parametrize(
    ("options", "started", "complaint"),
    [
        (["--nodes", "2"], None, "one command starts the processes of one machine only"),
        (["--nodes", "2"], "4", "torchrun started 4 processes, and --devices 1 --nodes 2 make 2"),
        ([], "2", "torchrun started 2 processes"),
        (["--nodes", "0"], None, "--nodes is 0"),
    ],
)
def test_inconsistent_numbers_of_processes_are_refused(
    tmp_path, capture, options, started, complaint, monkeypatch, capsys
):
    monkeypatch.setitem(PRESETS, "tiny", small_config)
    if started is not None:
        monkeypatch.setenv("TORCHELASTIC_RUN_ID", "none")
        monkeypatch.setenv("WORLD_SIZE", started)
    words = ["train", "--data", str(capture), "--out", str(tmp_path / "run"), "--preset", "tiny"]
    assert main([*words, "--device", "cpu", *options]) == 2
    assert complaint in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_an_input_error_is_printed_once(tmp_path, capture):
    with started(capture, capture) as process:
        _, complaint = process.communicate(timeout=30)
    assert process.returncode == 2
    assert (
        complaint == f"error: {capture}: exists already; choose another --out, or continue it with --resume\n"
    )


def test_only_the_first_process_prints_errors_and_sets_the_status(monkeypatch, capfd):
    """If a child ended with an error status, its parent would be killed."""
    assert main(["eval", "nowhere"]) == 2
    assert "no run here" in capfd.readouterr().err
    monkeypatch.setenv("LOCAL_RANK", "1")
    assert main(["eval", "nowhere"]) == 0
    assert capfd.readouterr().err == ""
