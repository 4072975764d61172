"""Read damaged files in child processes, whose memory is limited and which may crash.

    python -m tests.hard_cases.hostile.worker FOLDER REPORT FIRST READER=COUNT …

This process loads the modules of the readers once and is then copied (`fork`) for each reader. A copy records
the number of the input that it reads, so that its parent knows which input ended it; the next copy continues
after that input. REPORT has an `Outcome` for each reader.
"""

from __future__ import annotations

import json
import os
import resource
import signal
import sys
import time
import traceback
import warnings
from dataclasses import asdict, dataclass, field
from pathlib import Path

from neilfpp_method.errors import UserError
from tests.hard_cases.hostile.forbidden import watch
from tests.hard_cases.hostile.mutations import mutated
from tests.hard_cases.hostile.readers import READERS, Reader

ROOM = 1 << 30
"""Bytes of address space that a reader may take beside what the process had before."""
LARGEST_GROWTH = 512 << 20
"""Bytes of memory that all inputs together may add to the most that the process ever held."""
LONGEST = 5.0
"""Seconds of computing that one small file may take."""
ENDED_AFTER = 30.0
"""Seconds of computing after which a reader that does not return is ended."""
LONGEST_BY_CLOCK = 900
"""Seconds by the clock after which a reader that waits without computing is ended; many, because one that
works may take long on a loaded machine.
"""
LONGEST_LINE = 2000
"""Characters of a message: paths and a few words of the file."""


@dataclass
class Outcome:
    """What became of a reader's inputs.

    Attributes:
        read: inputs that gave a value.
        refused: inputs that gave one line.
        faults: everything else: the number of the input, the file, and what happened.
        grown: bytes by which memory grew.
    """

    read: int = 0
    refused: int = 0
    faults: list[tuple[int, str, str]] = field(default_factory=list)
    grown: int = 0


def attack(reader: Reader, folder: Path, first: int, count: int) -> Outcome:
    """Let a reader read `count` damaged files. A copy that dies or hangs is a fault."""
    capture, told, at = folder / "capture", folder / "told", folder / "at"
    capture.mkdir(parents=True)
    paths = reader.make(capture)
    whole = {path: path.read_bytes() for path in paths}
    for path in paths:  # modules that are loaded at first use do not count for a damaged file
        reader.read(capture, path)
    outcome, number, last = Outcome(), first, first + count
    while number < last:
        told.unlink(missing_ok=True)
        at.write_bytes(number.to_bytes(8, "little"))
        child = os.fork()
        if not child:
            try:
                _read_all(reader, capture, whole, range(number, last), told, at)
            except BaseException:
                traceback.print_exc()  # a fault of this program
            finally:
                os._exit(1)
        _, status = os.waitpid(child, 0)
        if told.exists():
            part = Outcome(**json.loads(told.read_text()))
            outcome.read += part.read
            outcome.refused += part.refused
            outcome.faults += part.faults
            outcome.grown = max(outcome.grown, part.grown)
        number = int.from_bytes(at.read_bytes(), "little")
        if status:
            died = signal.Signals(status & 127).name if status & 127 else f"status {status >> 8}"
            outcome.faults.append((number, paths[number % len(paths)].name, died))
            for path, content in whole.items():
                _replace(path, content)
        number += 1
    return outcome


def _read_all(
    reader: Reader, capture: Path, whole: dict[Path, bytes], numbers: range, told: Path, at: Path
) -> None:
    """In a copy of the process, which ends. Faults are written down at once, counts every hundred inputs."""
    held, paths, outcome = _address_space(), list(whole), Outcome()
    resource.setrlimit(resource.RLIMIT_AS, (held + ROOM, held + ROOM))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    before, forbidden = _peak(), watch(capture)
    with at.open("r+b", buffering=0) as place:
        for number in numbers:
            os.pwrite(place.fileno(), number.to_bytes(8, "little"), 0)
            path = paths[number % len(paths)]
            _replace(path, mutated(whole[path], number))
            forbidden()
            before_it = len(outcome.faults)
            began = time.process_time()
            # Either signal ends the process.
            signal.setitimer(signal.ITIMER_PROF, ENDED_AFTER)
            signal.alarm(LONGEST_BY_CLOCK)
            try:
                reader.read(capture, path)
                outcome.read += 1
            except UserError as error:
                outcome.refused += 1
                if fault := _fault(error):
                    outcome.faults.append((number, path.name, fault))
            except BaseException:
                outcome.faults.append((number, path.name, traceback.format_exc(limit=-4)))
            signal.alarm(0)
            signal.setitimer(signal.ITIMER_PROF, 0.0)
            outcome.faults += [(number, path.name, what) for what in forbidden()]
            if time.process_time() - began > LONGEST:
                outcome.faults.append((number, path.name, f"{time.process_time() - began:.1f} seconds"))
            _replace(path, whole[path])
            outcome.grown = _peak() - before
            whole_hundred = number % 100 == 99 or number + 1 == numbers.stop
            if whole_hundred or len(outcome.faults) > before_it:
                _write(told, outcome)
        if outcome.grown > LARGEST_GROWTH:
            outcome.faults.append((numbers.start, "", f"memory grew by {outcome.grown >> 20} MiB"))
            _write(told, outcome)
    os._exit(0)


def _replace(path: Path, content: bytes) -> None:
    """Write a new file. One that was cut to no length and written again would be sent to the disk at once."""
    path.unlink()
    path.write_bytes(content)


def _write(told: Path, outcome: Outcome) -> None:
    told.with_suffix(".new").write_text(json.dumps(asdict(outcome)))
    told.with_suffix(".new").replace(told)


def _fault(error: UserError) -> str | None:
    """What is wrong with an error message; empty if nothing is."""
    if "\n" in str(error) or len(str(error)) > LONGEST_LINE or not error.remedy:
        return f"not one line with a remedy: {str(error)[:3000]!r}"
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, MemoryError):
            return f"asks for more than {ROOM >> 20} MiB: {error}"
        cause = cause.__cause__ or cause.__context__
    return None


def _address_space() -> int:
    return int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()


def _peak() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss << 10


def main(folder: Path, report: Path, first: int, counts: dict[str, int]) -> None:
    warnings.simplefilter("ignore")
    outcomes = {}
    for i, (name, count) in enumerate(counts.items()):
        outcomes[name] = asdict(attack(READERS[name], folder / str(i), first, count))
        report.write_text(json.dumps(outcomes))


if __name__ == "__main__":
    chosen = {name: int(count) for name, count in (word.rsplit("=", 1) for word in sys.argv[4:])}
    main(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]), chosen)
