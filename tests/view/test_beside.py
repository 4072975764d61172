"""The viewer during a training, as a separate process."""

from __future__ import annotations

import contextlib
import shutil
import socket
import time
import urllib.request

import pytest

from neilfpp_method.cli import main
from neilfpp_method.train.checkpoint import last_checkpoint
from neilfpp_method.view.address import check_address
from neilfpp_method.view.beside import viewer_beside

pytest.importorskip("viser")
PATIENCE = 120.0
"""Seconds for a process to import torch and to load a run, on a busy machine."""


def served(port: int) -> bool:
    with contextlib.suppress(OSError), urllib.request.urlopen(f"http://127.0.0.1:{port}", timeout=5) as page:
        return page.status == 200
    return False


def test_the_page_is_served_while_the_context_runs(tmp_path, port):
    said = []
    with viewer_beside(tmp_path / "run", port, "cpu", said.append):
        ends = time.monotonic() + PATIENCE
        while not served(port):
            assert time.monotonic() < ends
            time.sleep(0.2)
    assert len(said) == 1
    assert f"http://127.0.0.1:{port}" in said[0]
    check_address("127.0.0.1", port)


def test_a_failed_viewer_is_reported_and_does_not_affect_the_training(found, tmp_path, port):
    run, said = tmp_path / "run", []
    shutil.copytree(found, run)
    last_checkpoint(run).write_bytes(b"not a checkpoint")
    with viewer_beside(run, port, "cpu", said.append) as viewer:
        viewer.wait(PATIENCE)
    assert "the viewer ended early: error: " in said[-1]
    assert "last.pt" in said[-1]


def test_training_with_a_busy_port_is_an_error_of_one_line(tmp_path, capture, capsys):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        words = ["train", "--data", str(capture), "--out", str(tmp_path / "run"), "--device", "cpu"]
        assert main([*words, "--view", "--view-port", str(port)]) == 2
    said = capsys.readouterr()
    assert said.err.startswith(f"error: port {port} of 127.0.0.1:")
    assert "choose another with --view-port" in said.err
    assert said.err.count("\n") == 1
    assert not (tmp_path / "run").exists()
