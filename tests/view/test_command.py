"""`neilfpp view`: what it serves, and what it refuses in one line."""

from __future__ import annotations

import os
import shutil
import socket
import urllib.request
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest

from neilfpp_method.cli import main
from neilfpp_method.data.files.images import write_exr
from neilfpp_method.train.checkpoint import last_checkpoint
from neilfpp_method.view import command
from neilfpp_method.view.address import check_address


def request(run: Path, port: int, **changes) -> command.ViewRequest:
    usual = {
        "env": (),
        "env_layout": "ours",
        "follow": False,
        "host": "127.0.0.1",
        "resolution": 32,
        "checkpoint": "last",
    }
    return command.ViewRequest(run=run, port=port, device="cpu", **{**usual, **changes})


def ends(capsys, *words: str) -> str:
    assert main(["view", *words]) == 2
    return capsys.readouterr().err


def test_a_surface_of_too_many_cells_is_refused(found, capsys):
    assert "100000 cells per side" in ends(capsys, str(found), "--resolution", "100000")


def test_the_page_is_served_until_it_is_ended(found, port):
    pytest.importorskip("viser")
    said, served = [], []

    def once(_seconds: float) -> bool:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/", timeout=10) as page:
            served.append(page.status)
        return True

    command.view(request(found, port), said.append, once)
    assert served == [200]
    assert said == [f"open http://127.0.0.1:{port} in a browser; press Ctrl-C to stop"]
    check_address("127.0.0.1", port)  # the port is free again


def test_following_waits_and_shows_each_new_checkpoint(found, port, tmp_path, monkeypatch):
    pytest.importorskip("viser")
    run, said, shown = tmp_path / "run", [], []
    from neilfpp_method.view import browser

    monkeypatch.setattr(browser.Page, "show", lambda self, subject: shown.append(subject.run.step))
    turns = iter(range(4))

    def turn(_seconds: float) -> bool:
        number = next(turns)
        if number == 0:
            shutil.copytree(found, run)
        if number == 2:
            os.utime(last_checkpoint(run))
        return number == 3

    command.view(request(run, port, follow=True), said.append, turn)
    assert said[0] == f"waiting for the first checkpoint of {run}"
    assert shown == [6, 6]


def test_an_address_open_to_other_machines_is_warned_about(found, port):
    pytest.importorskip("viser")
    said = []
    command.view(request(found, port, host="0.0.0.0"), said.append, lambda _: True)
    assert said[0].startswith("warning: everybody")


def test_a_busy_port_is_one_line(capsys, found, port):
    pytest.importorskip("viser")
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", port))
        taken.listen()
        line = ends(capsys, str(found), "--port", str(port))
    assert line.startswith(f"error: port {port} of 127.0.0.1:")
    assert line.count("\n") == 1


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (["--port", "70000"], "--port 70000: no such port"),
        (["--host", "no.such.host.invalid"], "no such address"),
        (["--host", "two..dots"], "--host two..dots: no such address"),
        (["--env", "missing.exr"], "missing.exr"),
    ],
)
def test_bad_options_are_one_line(capsys, found, words, part):
    pytest.importorskip("viser")
    line = ends(capsys, str(found), *words)
    assert part in line
    assert line.count("\n") == 1


def test_no_run_is_one_line(capsys, tmp_path, port):
    pytest.importorskip("viser")
    assert "no run here" in ends(capsys, str(tmp_path), "--port", str(port))


def test_without_the_library_the_line_names_the_command(capsys, found, monkeypatch):
    def missing(name):
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(command.metadata, "version", missing)
    assert "pip install 'neilfpp-method[view]'" in ends(capsys, str(found))
    monkeypatch.setattr(command.metadata, "version", lambda name: "0.2.7")
    assert "0.2.7 is installed" in ends(capsys, str(found))


def test_a_folder_of_maps_stands_for_all_its_maps(tmp_path):
    for name, value in (("noon", 2.0), ("dusk", 0.5)):
        radiance = np.full((8, 16), value, np.float32)
        write_exr(tmp_path / f"{name}.exr", {channel: radiance for channel in "RGB"})
    skies = command._skies((tmp_path,), "ours")
    assert {name: sky.radiance.mean().item() for name, sky in skies.items()} == {"dusk": 0.5, "noon": 2.0}
