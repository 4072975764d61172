"""Kill commands at random moments and check what they leave behind.

    python -m tests.hard_cases.faults.campaign FOLDER REPORT SEED KILLS

This process loads the package once; every command runs in a copy of it (`fork`). REPORT has the number of
kills by command and signal, and every fault: a traceback, an unexpected exit status, a file under its final
name that cannot be read, or a result that is not bit for bit that of an uninterrupted command.
"""

from __future__ import annotations

import json
import os
import random
import signal
import sys
import time
import traceback
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import OpenEXR
import torch
import trimesh

from neilfpp_method.cli import main as neilfpp
from neilfpp_method.data.files.images import read_image, write_exr
from neilfpp_method.errors import UserError
from neilfpp_method.prepare.layout import WORK
from neilfpp_method.settings.presets import PRESETS
from neilfpp_method.train.checkpoint import last_checkpoint, load_checkpoint
from tests.data.make_capture import make_capture
from tests.prepare.textured_corner import make_photos
from tests.train.small_runs import differences, small_config

SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
EXPECTED = {0, -signal.SIGKILL, -signal.SIGTERM, 130, 143}
"""Done, killed, ended before Python could answer, stopped by Ctrl-C, stopped by SIGTERM."""


@dataclass
class Report:
    """Counts of kills, and faults."""

    kills: Counter[str] = field(default_factory=Counter)
    files: int = 0
    faults: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Ended:
    """The end of a command: its exit status (negative: the signal), its standard error, and its seconds."""

    status: int
    said: str
    seconds: float


def run(
    folder: Path, *words: str, kill: signal.Signals | None = None, after: float = 0.0, twice: bool = False
) -> Ended:
    """Run a command in a copy of this process; `kill` it after so many seconds, `twice` in a row."""
    said, began = folder / "said", time.monotonic()
    said.write_text("")
    asking = {signal.SIGINT, signal.SIGTERM}
    signal.pthread_sigmask(signal.SIG_BLOCK, asking)  # a copy receives them once it is a command
    child = os.fork()
    if not child:
        _become_command(said, words, asking)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, asking)
    if kill is not None:
        time.sleep(after)
        for _ in range(1 + twice):
            os.kill(child, kill)  # it was not waited for, so its process id is still valid
    _, status = os.waitpid(child, 0)
    return Ended(os.waitstatus_to_exitcode(status), said.read_text(), time.monotonic() - began)


def _become_command(said: Path, words: tuple[str, ...], asking: set[signal.Signals]) -> None:
    """Run a command in this process; never returns, because later code belongs to the parent process."""
    status = 1
    try:
        errors, nowhere = os.open(said, os.O_WRONLY | os.O_APPEND), os.open(os.devnull, os.O_WRONLY)
        os.dup2(errors, 2)
        os.dup2(nowhere, 1)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, asking)
        status = neilfpp(list(words))
    except KeyboardInterrupt:  # before the command, or behind it
        status = 130
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(status)


def check_end(report: Report, what: str, ended: Ended) -> None:
    """Check that no traceback is printed and that the exit status is an expected one."""
    told = [line for line in ended.said.splitlines() if not line.startswith("step ")]
    if ended.status not in EXPECTED or "Traceback" in ended.said or "*** " in ended.said or len(told) > 1:
        report.faults.append(f"{what}: status {ended.status}: {ended.said[-800:]}")


def check_files(report: Report, what: str, folder: Path) -> None:
    """Check that every file under its final name is complete. Files that are being written have hidden
    names.
    """
    for path in folder.rglob("*"):
        if path.name.startswith(".") or not path.is_file():
            continue
        report.files += 1
        try:
            if path.suffix == ".pt":
                load_checkpoint(path)
            elif path.suffix == ".json":
                json.loads(path.read_text())
            elif path.suffix == ".png":
                read_image(path)
            elif path.suffix == ".exr":  # several layers: a capture cannot contain such an image
                OpenEXR.File(str(path))
            elif path.suffix in (".ply", ".glb", ".obj"):
                trimesh.load(path)
        except (UserError, ValueError, RuntimeError) as error:
            report.faults.append(f"{what}: {path.name} is not whole: {error}")


def train_words(folder: Path, out: Path, resume: bool) -> list[str]:
    words = ["train", "--out", str(out), "--device", "cpu", "--no-report"]
    return [*words, "--resume"] if resume else [*words, "--data", str(folder / "capture"), "--preset", "tiny"]


def attack_training(report: Report, folder: Path, draw: random.Random, kills: int) -> Path:
    """Kill trainings, up to four times each, and let each finish; returns one that was not interrupted."""
    whole = folder / "whole"
    took = run(folder, *train_words(folder, whole, resume=False))
    if took.status:
        raise RuntimeError(took.said)
    wanted = torch.load(last_checkpoint(whole), weights_only=True)
    number = 0
    while sum(report.kills.values()) < kills:
        out, number = folder / f"run-{number}", number + 1
        for _ in range(draw.randint(1, 4)):
            kill, twice = draw.choice(SIGNALS), draw.random() < 0.25
            what = f"train, {kill.name}{' twice' if twice else ''}"
            words = train_words(folder, out, resume=(out / "config.json").exists())
            ended = run(folder, *words, kill=kill, after=draw.uniform(0.0, 1.1 * took.seconds), twice=twice)
            report.kills[what] += 1
            check_end(report, what, ended)
            check_files(report, what, out)
        ended = run(folder, *train_words(folder, out, resume=(out / "config.json").exists()))
        if ended.status:
            report.faults.append(f"train goes on: status {ended.status}: {ended.said[-800:]}")
            continue
        found = torch.load(last_checkpoint(out), weights_only=True)
        report.faults += [
            f"train: {place} is not that of a run that was never killed"
            for place in differences(found, wanted)
        ]
    return whole


SKY = "sky.exr"
"""An environment map, in the folder of the campaign."""
COMMANDS = (
    ("eval",),
    ("render", "--overwrite"),
    ("export", "--what", "mesh", "light", "--resolution", "32"),
    ("relight", "--spp", "2", "--force", "--env", SKY),
    ("report",),
)
"""Commands that read a run and write into its folder."""


def attack_command(report: Report, folder: Path, words: list[str], draw: random.Random, kills: int) -> None:
    """Kill a command that reads a run, then let it finish; the run must stay intact throughout."""
    whole = run(folder, *words)
    if whole.status:
        report.faults.append(f"{words[0]}: cannot be run: {whole.said[-800:]}")
        return
    for _ in range(kills):
        kill = draw.choice(SIGNALS)
        what = f"{words[0]}, {kill.name}"
        ended = run(folder, *words, kill=kill, after=draw.uniform(0.0, whole.seconds))
        report.kills[what] += 1
        check_end(report, what, ended)
        check_files(report, what, Path(words[1]))
    ended = run(folder, *words)
    if ended.status:
        report.faults.append(f"{words[0]} after kills: status {ended.status}: {ended.said[-800:]}")


def attack_prepare(report: Report, folder: Path, draw: random.Random, kills: int) -> None:
    """Kill `prepare` up to three times per capture, COLMAP's steps included, and let each capture finish.

    The files of a capture must be those of one that was never interrupted, byte for byte.
    """
    photos, whole = folder / "photos", folder / "prepared"
    make_photos(photos, views=4, size=(200, 150))

    def words(out: Path) -> list[str]:
        return ["prepare", str(photos), "--out", str(out), "--cloud", "dense"]

    took = run(folder, *words(whole))
    if took.status:
        report.faults.append(f"prepare: cannot be run: {took.said[-800:]}")
        return
    wanted, number, done = capture_files(whole), 0, 0
    while done < kills:
        out, number = folder / f"prepared-{number}", number + 1
        for _ in range(draw.randint(1, 3)):
            kill = draw.choice(SIGNALS)
            what, done = f"prepare, {kill.name}", done + 1
            ended = run(folder, *words(out), kill=kill, after=draw.uniform(0.0, took.seconds))
            report.kills[what] += 1
            check_end(report, what, ended)
            check_files(report, what, out)
        ended = run(folder, *words(out))
        if ended.status:
            report.faults.append(f"prepare goes on: status {ended.status}: {ended.said[-800:]}")
            continue
        found = capture_files(out)
        report.faults += [
            f"prepare: {name} is not that of a capture that was never interrupted"
            for name in sorted(wanted.keys() | found.keys())
            if wanted.get(name) != found.get(name)
        ]


def capture_files(out: Path) -> dict[str, bytes]:
    """The files of a prepared capture by name, without the work of its steps and unfinished files."""
    inside = (path.relative_to(out) for path in out.rglob("*") if path.is_file())
    return {
        str(path): (out / path).read_bytes()
        for path in inside
        if path.parts[0] != WORK and not path.name.startswith(".")
    }


def main(folder: Path, report_file: Path, seed: int, kills: int) -> None:
    PRESETS["tiny"] = small_config
    draw, report = random.Random(seed), Report()
    make_capture(folder / "capture", masks=True)
    whole = attack_training(report, folder, draw, kills)
    write_exr(folder / SKY, {"RGB": np.full((8, 16, 3), 0.5, np.float32)})
    each = kills // 10
    for name, *options in COMMANDS if each else ():
        words = [str(folder / SKY) if option == SKY else option for option in options]
        attack_command(report, folder, [name, str(whole), *words], draw, each)
    if each:
        attack_prepare(report, folder, draw, each)
    told = {"kills": dict(report.kills), "files": report.files, "faults": report.faults}
    report_file.write_text(json.dumps(told, indent=1))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4]))
