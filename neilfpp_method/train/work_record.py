"""The time of a run by stage and by kind of work, stored in `RUN/work.json` (docs/budget.md)."""

from __future__ import annotations

from pathlib import Path

from neilfpp_method.data.files.json_entry import write_json
from neilfpp_method.errors import UserError
from neilfpp_method.timing.ledger import WORK, Ledger
from neilfpp_method.train.json_files import is_finite_number, read_json

__all__ = ["FILE", "read_work", "write_work"]

FILE = "work.json"
FORMAT = 1


def write_work(run: Path, ledger: Ledger) -> None:
    """Write the times so far, of all sessions of the run, into the run folder."""
    write_json(run / FILE, {"format": FORMAT, "seconds": ledger.seconds()})


def read_work(run: Path) -> dict[str, dict[str, float]]:
    """Read the seconds of a run by stage and by kind of work; empty if the run has no record.

    Raises:
        UserError: if the file is damaged or of another version.
    """
    path = run / FILE
    if not path.is_file():
        return {}
    stored = read_json(path)
    if stored.get("format") != FORMAT:
        raise UserError(
            f"{path}: a record of another version", "remove the file, or use the version that wrote it"
        )
    stages = stored.get("seconds")
    if not isinstance(stages, dict) or not all(isinstance(parts, dict) for parts in stages.values()):
        raise UserError(f"{path}: not a complete record", "remove the file, or train again")
    for stage, parts in stages.items():
        for work, seconds in parts.items():
            good = is_finite_number(seconds) and seconds >= 0
            if work not in WORK or not good:
                raise UserError(
                    f"{path}: {stage}.{work}: not a valid time", "remove the file, or train again"
                )
    return stages
