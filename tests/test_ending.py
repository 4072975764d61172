"""Commands that are interrupted: one line, the exit status that shells expect, and no incomplete file."""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
from rich.console import Console

from neilfpp_method.cli import main
from neilfpp_method.commands import COMMANDS
from neilfpp_method.data.files.atomic_file import replacing
from neilfpp_method.data.native_signals import signals_delayed

REPOSITORY = Path(__file__).parent.parent


@dataclass
class Nothing:
    """No options."""


def command(monkeypatch: pytest.MonkeyPatch, run: Callable[[object], None]) -> list[str]:
    """The words of a command that runs this function."""
    monkeypatch.setitem(COMMANDS, "inspect", replace(COMMANDS["inspect"], options=Nothing, run=run))
    return ["inspect"]


def ended(program: str, *words: str) -> subprocess.CompletedProcess[str]:
    """The end of a process that runs a program before the command line. Ctrl-C is not ignored in it, as it is
    in background jobs of a shell.
    """
    listening = "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler)"
    start = "from neilfpp_method.__main__ import main; sys.exit(main())"
    command = [sys.executable, "-c", "\n".join([listening, program, start]), *words]
    return subprocess.run(command, capture_output=True, text=True)


WHILE_IMPORTED = """
class Interrupting:
    def find_spec(self, name, *_):
        if name == "{module}":
            signal.raise_signal(signal.{signal})

sys.meta_path.insert(0, Interrupting())
"""


@pytest.mark.parametrize("module", ["neilfpp_method.cli", "numpy"])
@pytest.mark.parametrize(("number", "status"), [("SIGINT", 130), ("SIGTERM", 143)])
def test_a_signal_while_modules_are_imported(tmp_path, module, number, status):
    program = WHILE_IMPORTED.format(module=module, signal=number)
    done = ended(program, "inspect", str(tmp_path / "no-capture"))
    assert (done.returncode, done.stderr) == (status, "stopped\n")


WHILE_HANDLERS_ARE_SET = """
import neilfpp_method.commands.ending as ending
real, calls = signal.signal, []

def set_handler(number, handler):
    before = real(number, handler)
    calls.append(number)
    if len(calls) == {call}:
        signal.raise_signal(signal.{signal})
    return before

import neilfpp_method.cli
ending.signal.signal = set_handler
"""


@pytest.mark.parametrize("number", ["SIGINT", "SIGTERM"])
@pytest.mark.parametrize("call", [1, 2, 3])
def test_a_signal_while_handlers_are_set(number, call):
    """The first call is that of the start, the others those of the command."""
    done = ended(WHILE_HANDLERS_ARE_SET.format(call=call, signal=number), "--version")
    assert (done.returncode, done.stderr) == ({"SIGINT": 130, "SIGTERM": 143}[number], "stopped\n")


@pytest.mark.parametrize("number", ["SIGINT", "SIGTERM"])
@pytest.mark.parametrize("call", [4, 5])
def test_a_signal_after_the_command_prints_no_traceback(number, call):
    done = ended(WHILE_HANDLERS_ARE_SET.format(call=call, signal=number), "--version")
    assert done.stdout.startswith("neilfpp ")
    assert (done.returncode, done.stderr) == (-getattr(signal, number), "")


def test_a_second_signal_while_the_end_is_printed(monkeypatch, capfd):
    printed = Console.print

    def interrupted(console: Console, *words: object, **options: object) -> None:
        signal.raise_signal(signal.SIGINT)
        printed(console, *words, **options)

    monkeypatch.setattr(Console, "print", interrupted)
    assert main(command(monkeypatch, lambda _: signal.raise_signal(signal.SIGTERM))) == 143
    assert capfd.readouterr().err == "stopped\n"


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_command_ends_in_one_line(monkeypatch, capfd, tmp_path, number, status):
    def work(_: object) -> None:
        with replacing(tmp_path / "result.txt") as temporary:
            temporary.write_text("half of")
            signal.raise_signal(number)

    before = signal.getsignal(number)
    assert main(command(monkeypatch, work)) == status
    assert capfd.readouterr().err == "stopped\n"
    assert not list(tmp_path.iterdir())
    assert signal.getsignal(number) is before


def test_exceptions_of_libraries_after_ctrl_c_are_not_shown(monkeypatch, capfd):
    def load(_: object) -> None:
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            raise ImportError("initialization failed") from None

    assert main(command(monkeypatch, load)) == 130
    assert capfd.readouterr().err == "stopped\n"


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_in_a_callback_of_a_library_ends_the_command(monkeypatch, capfd, number, status):
    """Python ignores exceptions in callbacks from C, such as those of Numba's compiler."""
    times = []

    @ctypes.CFUNCTYPE(None)
    def callback() -> None:
        times.append(time.monotonic())
        if len(times) == 1:
            signal.raise_signal(number)
        time.sleep(0.2)

    def work(_: object) -> None:
        callback()
        callback()
        time.sleep(30)

    assert main(command(monkeypatch, work)) == status
    assert capfd.readouterr().err == "stopped\n"
    assert time.monotonic() - times[0] < 20


def test_finalisers_of_objects_that_a_signal_left_half_made_are_silent(monkeypatch, capfd):
    class HalfMade:
        def __init__(self) -> None:
            signal.raise_signal(signal.SIGTERM)
            self.closed = False

        def __del__(self) -> None:
            assert not self.closed

    monkeypatch.setattr(sys, "unraisablehook", sys.__unraisablehook__)
    assert main(command(monkeypatch, lambda _: HalfMade())) == 143
    assert capfd.readouterr().err == "stopped\n"


def test_other_exceptions_in_a_callback_are_shown(monkeypatch, capfd):
    @ctypes.CFUNCTYPE(None)
    def callback() -> None:
        raise ValueError("a fault of ours")

    monkeypatch.setattr(sys, "unraisablehook", sys.__unraisablehook__)
    assert main(command(monkeypatch, lambda _: callback())) == 0
    assert "a fault of ours" in capfd.readouterr().err


def test_other_errors_are_shown(monkeypatch):
    def fail(_: object) -> None:
        raise ImportError("a fault of ours")

    with pytest.raises(ImportError, match="a fault of ours"):
        main(command(monkeypatch, fail))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_wait_for_a_library_that_installs_its_own_handler(number):
    told: list[str] = []
    before = signal.signal(number, lambda *_: told.append("ours"))
    try:
        with signals_delayed():
            signal.signal(number, lambda *_: told.append("the library's"))
            signal.raise_signal(number)
            assert told == []
        assert told == ["ours"]
    finally:
        signal.signal(number, before)


def test_signals_wait_that_another_thread_receives():
    """Threads from before the block do not block the signals, as those of OpenBLAS."""
    told: list[int] = []
    before = signal.signal(signal.SIGTERM, lambda number, _: told.append(number))
    done = threading.Event()
    other = threading.Thread(target=done.wait)
    other.start()
    try:
        with signals_delayed():
            signal.pthread_kill(other.ident, signal.SIGTERM)
            time.sleep(0.1)
            assert told == []
        assert told == [signal.SIGTERM]
    finally:
        done.set()
        signal.signal(signal.SIGTERM, before)


IN_USD = """
import os, signal, sys
from importlib._bootstrap_external import FileFinder

def raising(number, frame):
    raise KeyboardInterrupt

fill = FileFinder._fill_cache

def interrupting(self):
    if self.path.endswith(os.path.join("pxr", "Plug")):
        os.kill(os.getpid(), signal.{signal})
    return fill(self)

signal.signal(signal.{signal}, raising)
FileFinder._fill_cache = interrupting
try:
    import neilfpp_method.export.asset.usd
except KeyboardInterrupt:
    sys.exit(5)
"""


@pytest.mark.parametrize("number", ["SIGINT", "SIGTERM"])
def test_a_signal_while_usd_is_loaded_is_not_swallowed(number):
    """USD's loader of modules catches exceptions, prints them, and goes on without the module."""
    program = IN_USD.format(signal=number)
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (5, "")


IN_CODE_FROM_A_STRING = """
import dataclasses, os, signal, sys
from neilfpp_method.__main__ import main
from neilfpp_method.commands import COMMANDS

@dataclasses.dataclass
class Nothing:
    pass

def run(options):
    exec("import os, signal; os.kill(os.getpid(), signal.SIGTERM)")

COMMANDS["inspect"] = dataclasses.replace(COMMANDS["inspect"], options=Nothing, run=run)
sys.exit(main())
"""


def test_the_exit_status_stands_after_a_signal_in_code_from_a_string(tmp_path: Path):
    """Otherwise `python -m` ends by SIGINT."""
    (tmp_path / "interrupted.py").write_text(IN_CODE_FROM_A_STRING)
    command = [sys.executable, "-m", "interrupted", "inspect"]
    here = {**os.environ, "PYTHONPATH": f"{tmp_path}{os.pathsep}{REPOSITORY}"}
    done = subprocess.run(command, capture_output=True, text=True, env=here)
    assert (done.returncode, done.stderr) == (143, "stopped\n")


def test_a_stopped_write_keeps_the_old_file(monkeypatch, tmp_path: Path):
    path = tmp_path / "result.txt"
    path.write_text("whole")

    def work(_: object) -> None:
        with replacing(path) as temporary:
            temporary.write_text("half of")
            signal.raise_signal(signal.SIGTERM)

    assert main(command(monkeypatch, work)) == 143
    assert [file.name for file in tmp_path.iterdir()] == ["result.txt"]
    assert path.read_text() == "whole"


def test_output_that_is_no_longer_read_is_no_error():
    """As in `neilfpp train --help-all | head -1`."""
    code = (
        "import sys, time; from neilfpp_method.cli import main; time.sleep(0.2);"
        "sys.exit(main(['train', '--help-all']))"
    )
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    process.stdout.close()
    assert process.stderr.read() == b""
    assert process.wait() == 141
