"""The findings of a run, stored in `RUN/health.json` with each checkpoint and read by eval and report."""

from __future__ import annotations

from pathlib import Path

from neilfpp_method.data.files.json_entry import write_json
from neilfpp_method.health.cases import Finding
from neilfpp_method.health.watch import FILE, FORMAT, Watch
from neilfpp_method.train.json_files import read_entries

__all__ = ["read_findings", "write_findings"]


def write_findings(run: Path, watch: Watch) -> None:
    """Write the findings so far, and the verdict that follows from them, into the run folder."""
    write_json(run / FILE, watch.record())


def read_findings(run: Path) -> list[Finding] | None:
    """Read the findings of a run.

    Returns:
        The findings; None if the run has no record because nothing has been saved yet.

    Raises:
        UserError: if the file is damaged or of another version.
    """
    return read_entries(run / FILE, FORMAT, "findings", Finding)
