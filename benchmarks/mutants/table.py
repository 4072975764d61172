"""The table of docs/stability.md: the faults, and the test that notices each."""

from __future__ import annotations

import re
from collections.abc import Sequence

from benchmarks.mutants.faults import MUTANTS
from benchmarks.mutants.planting import ROOT, Outcome

__all__ = ["DOCUMENT", "table", "write_table"]

DOCUMENT = ROOT / "docs" / "stability.md"
"""The document with the table."""
MARKED = re.compile(r"(<!-- mutants -->\n).*?(<!-- end -->)", re.DOTALL)


def table(outcomes: Sequence[Outcome]) -> str:
    """Return the outcomes as a Markdown table."""
    rows = ["| fault | in | noticed by |", "|---|---|---|"]
    for outcome in outcomes:
        by = "**nothing**" if outcome.noticed_by is None else f"`{outcome.noticed_by}`"
        rows.append(f"| {outcome.mutant.what} | `{outcome.mutant.module}` | {by} |")
    return "\n".join(rows) + "\n"


def _read_table(text: str) -> list[Outcome]:
    """The outcomes in the document, except those of faults that no longer exist."""
    by_name = {(mutant.what, mutant.module): mutant for mutant in MUTANTS}
    rows = re.findall(r"^\| (.+?) \| `(.+?)` \| (?:`(.+?)`|\*\*nothing\*\*) \|$", text, re.MULTILINE)
    return [Outcome(by_name[row[:2]], row[2] or None) for row in rows if row[:2] in by_name]


def write_table(outcomes: Sequence[Outcome]) -> None:
    """Write outcomes into the table of the document; rows of other faults are left unchanged."""
    text = DOCUMENT.read_text("utf-8")
    outcome_of = {(v.mutant.what, v.mutant.module): v for v in (*_read_table(text), *outcomes)}
    rows = [outcome_of[m.what, m.module] for m in MUTANTS if (m.what, m.module) in outcome_of]
    noticed = sum(outcome.noticed_by is not None for outcome in rows)
    section = f"{table(rows)}\n{noticed} of {len(rows)} are noticed.\n"
    DOCUMENT.write_text(MARKED.sub(lambda m: f"{m[1]}\n{section}{m[2]}", text), "utf-8")
