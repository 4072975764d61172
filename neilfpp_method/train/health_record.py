"""The findings of a run, stored in `RUN/health.json` with each checkpoint and read by eval and report."""

from __future__ import annotations

from pathlib import Path

from neilfpp_method.errors import UserError
from neilfpp_method.health.cases import Finding, Health
from neilfpp_method.health.watch import FILE, FORMAT, Watch
from neilfpp_method.settings.plain import from_dict
from neilfpp_method.train.run import read_json, write_json

__all__ = ["health_summary", "read_findings", "write_findings"]


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
    path = run / FILE
    if not path.is_file():
        return None
    stored = read_json(path)
    if stored.get("format") != FORMAT or not isinstance(stored.get("findings"), list):
        raise UserError(
            f"{path}: a record of another version", "remove the file, or use the version that wrote it"
        )
    try:
        return [from_dict(Finding, finding, str(path)) for finding in stored["findings"]]
    except (TypeError, AttributeError) as error:
        raise UserError(
            f"{path}: not a complete record ({error})", "remove the file, or train again"
        ) from error


def health_summary(findings: list[Finding]) -> str:
    """The verdict in one line."""
    return str(Health.of(findings))
