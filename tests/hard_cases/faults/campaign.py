"""Kill commands at random moments and check what they leave behind.

    python -m tests.hard_cases.faults.campaign FOLDER REPORT SEED KILLS

This process loads the package once; every command runs in a copy of it (`fork`). REPORT has the number of
kills by command and signal, and every fault: a traceback, an unexpected exit status, a file under its final
name that cannot be read, or a result that is not bit for bit that of an uninterrupted command. The times that
`relight` records are the only difference that is permitted.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import sys
import time
import traceback
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from neilfpp_method.cli import main as neilfpp
from neilfpp_method.data.files.images import write_exr
from neilfpp_method.prepare.layout import WORK
from neilfpp_method.settings.presets import PRESETS
from neilfpp_method.train import command as train_command
from neilfpp_method.train.checkpoint import last_checkpoint
from tests.coarse_hulls import start_geometry
from tests.data.make_capture import make_capture
from tests.hard_cases.faults.whole_files import check_whole, comparable_files, visible_files
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
    """The end of a command: its exit status (negative: the signal), its standard error, its seconds, and
    whether it was still running when it was to be killed.
    """

    status: int
    said: str
    seconds: float
    was_killed: bool


def run(
    folder: Path, *words: str, kill: signal.Signals | None = None, after: float = 0.0, twice: bool = False
) -> Ended:
    """Run a command in a copy of this process; `kill` it after so many seconds, `twice` in a row, unless it
    has ended before.
    """
    said, began = folder / "said", time.monotonic()
    said.write_text("")
    asking = {signal.SIGINT, signal.SIGTERM}
    signal.pthread_sigmask(signal.SIG_BLOCK, asking)  # a copy receives them once it is a command
    child = os.fork()
    if not child:
        _become_command(said, words, asking)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, asking)
    was_killed = kill is not None and _is_running_after(child, after)
    if was_killed:
        for _ in range(1 + twice):
            os.kill(child, kill)  # it was not waited for, so its process id is still valid
    _, status = os.waitpid(child, 0)
    seconds = time.monotonic() - began
    return Ended(os.waitstatus_to_exitcode(status), said.read_text(), seconds, was_killed)


def _is_running_after(child: int, seconds: float) -> bool:
    """Wait for so many seconds, or until a process ends, and return whether it is still running."""
    end = time.monotonic() + seconds
    while os.waitid(os.P_PID, child, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None:
        if time.monotonic() >= end:
            return True
        time.sleep(0.005)
    return False


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
    """Check that every file under its final name is complete."""
    for path in visible_files(folder):
        report.files += 1
        error = check_whole(path)
        if error is not None:
            report.faults.append(f"{what}: {path.name} is not whole: {error}")


def train_words(folder: Path, out: Path, resume: bool) -> list[str]:
    words = ["train", "--out", str(out), "--device", "cpu", "--no-report"]
    return [*words, "--resume"] if resume else [*words, "--data", str(folder / "capture"), "--preset", "tiny"]


def attack_training(report: Report, folder: Path, draw: random.Random, kills: int) -> Path:
    """Kill trainings, up to four times each, and let each finish; returns one that was not interrupted."""
    whole = folder / "whole"
    # The first training may have to compile loops, which would make the range of random moments too long.
    run(folder, *train_words(folder, folder / "first", resume=False))
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
            report.kills[what] += ended.was_killed
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


SKY, RUN, OTHER = "SKY", "RUN", "OTHER"
"""In the words of a command: an environment map, a finished run, and a copy of it."""
COMMANDS = (
    ("eval", RUN),
    ("render", RUN, "--overwrite"),
    ("export", RUN, "--what", "mesh", "light", "--resolution", "32"),
    ("export", RUN, "--what", "asset", "--resolution", "32", "--texture-size", "64", "--faces", "400"),
    ("relight", RUN, "--spp", "2", "--force", "--resolution", "32", "--env", SKY),
    (
        *("relight", RUN, "--spp", "2", "--force", "--resolution", "32", "--out", f"{RUN}/turned"),
        *("--views", "turntable", "--frames", "3", "--env", SKY),
    ),
    ("report", RUN),
    ("compare", RUN, OTHER, "--out", f"{RUN}/compared"),
)
"""Commands that read a run and write into its folder."""


def attack_command(
    report: Report, run_folder: Path, words: list[str], draw: random.Random, kills: int
) -> None:
    """Kill a command that reads a run, up to three times, and let it finish, over and over.

    After a kill, a file under its final name is that of before the command or that of an uninterrupted
    command, byte for byte. After the command has finished, all files are those of an uninterrupted one.
    """
    folder, before = run_folder.parent, comparable_files(run_folder)
    shutil.copytree(run_folder, original := folder / "original")
    whole = run(folder, *words)
    if whole.status:
        report.faults.append(f"{words[0]}: cannot be run: {whole.said[-800:]}")
        shutil.rmtree(original)
        return
    wanted, done = comparable_files(run_folder), 0
    while done < kills:
        if draw.random() < 0.7:  # else the command writes over its own files
            shutil.rmtree(run_folder)
            shutil.copytree(original, run_folder)
        for _ in range(min(draw.randint(1, 3), kills - done)):
            kill = draw.choice(SIGNALS)
            what = f"{words[0]}, {kill.name}"
            ended = run(folder, *words, kill=kill, after=draw.uniform(0.0, whole.seconds))
            report.kills[what] += ended.was_killed
            done += ended.was_killed
            check_end(report, what, ended)
            check_files(report, what, run_folder)
            report.faults += [
                f"{what}: {name} is neither that of before nor that of an uninterrupted command"
                for name, content in comparable_files(run_folder).items()
                if content not in (before.get(name), wanted.get(name))
            ]
        ended = run(folder, *words)
        if ended.status:
            report.faults.append(f"{words[0]} after kills: status {ended.status}: {ended.said[-800:]}")
        compare_files(report, f"{words[0]} after kills", comparable_files(run_folder), wanted)
    shutil.rmtree(original)


def compare_files(report: Report, what: str, found: dict[str, bytes], wanted: dict[str, bytes]) -> None:
    """Check that a command that was killed and repeated has left the files of an uninterrupted one."""
    report.faults += [
        f"{what}: {name} is not that of a command that was never interrupted"
        for name in sorted(wanted.keys() | found.keys())
        if wanted.get(name) != found.get(name)
    ]


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
            what = f"prepare, {kill.name}"
            ended = run(folder, *words(out), kill=kill, after=draw.uniform(0.0, took.seconds))
            report.kills[what] += ended.was_killed
            done += ended.was_killed
            check_end(report, what, ended)
            check_files(report, what, out)
        ended = run(folder, *words(out))
        if ended.status:
            report.faults.append(f"prepare goes on: status {ended.status}: {ended.said[-800:]}")
            continue
        compare_files(report, "prepare after kills", capture_files(out), wanted)


def capture_files(out: Path) -> dict[str, bytes]:
    """The files of a prepared capture by name, without the work of its steps and unfinished files."""
    return {name: content for name, content in comparable_files(out).items() if Path(name).parts[0] != WORK}


def main(folder: Path, report_file: Path, seed: int, kills: int) -> None:
    PRESETS["tiny"] = small_config
    train_command.start_geometry = start_geometry
    draw, report = random.Random(seed), Report()
    make_capture(folder / "capture", masks=True)
    whole = attack_training(report, folder, draw, kills)
    sky, other = folder / "sky.exr", folder / "other"
    write_exr(sky, {"RGB": np.full((8, 16, 3), 0.5, np.float32)})
    shutil.copytree(whole, other)
    each = kills // 10
    for command in COMMANDS if each else ():
        places = {SKY: str(sky), RUN: str(whole), OTHER: str(other)}
        words = [places.get(word, word.replace(RUN, str(whole))) for word in command]
        attack_command(report, whole, words, draw, each)
    if each:
        attack_prepare(report, folder, draw, each)
    told = {"kills": dict(report.kills), "files": report.files, "faults": report.faults}
    report_file.write_text(json.dumps(told, indent=1))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4]))
