"""The table of docs/stability.md: the faults, and the test that notices each."""

from __future__ import annotations

import re
from collections.abc import Sequence

from benchmarks.mutants.faults import MUTANTS
from benchmarks.mutants.planting import ROOT, Verdict

__all__ = ["DOCUMENT", "table", "write_table"]

DOCUMENT = ROOT / "docs" / "stability.md"
"""The document with the table."""
MARKED = re.compile(r"(<!-- mutants -->\n).*?(<!-- end -->)", re.DOTALL)


def table(verdicts: Sequence[Verdict]) -> str:
    """The verdicts in Markdown."""
    rows = ["| fault | in | noticed by |", "|---|---|---|"]
    for verdict in verdicts:
        by = "**nothing**" if verdict.noticed_by is None else f"`{verdict.noticed_by}`"
        rows.append(f"| {verdict.mutant.what} | `{verdict.mutant.module}` | {by} |")
    return "\n".join(rows) + "\n"


def _read_table(text: str) -> list[Verdict]:
    """The verdicts that the document has on faults that are still planted."""
    by_name = {(mutant.what, mutant.module): mutant for mutant in MUTANTS}
    rows = re.findall(r"^\| (.+?) \| `(.+?)` \| (?:`(.+?)`|\*\*nothing\*\*) \|$", text, re.MULTILINE)
    return [Verdict(by_name[row[:2]], row[2] or None) for row in rows if row[:2] in by_name]


def write_table(verdicts: Sequence[Verdict]) -> None:
    """Put verdicts into the table of the document; rows of other faults stay as they are."""
    text = DOCUMENT.read_text("utf-8")
    verdict_of = {(v.mutant.what, v.mutant.module): v for v in (*_read_table(text), *verdicts)}
    rows = [verdict_of[m.what, m.module] for m in MUTANTS if (m.what, m.module) in verdict_of]
    noticed = sum(verdict.noticed_by is not None for verdict in rows)
    section = f"{table(rows)}\n{noticed} of {len(rows)} are noticed.\n"
    DOCUMENT.write_text(MARKED.sub(lambda m: f"{m[1]}\n{section}{m[2]}", text), "utf-8")
