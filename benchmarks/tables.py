"""The tables of the documents (`NAMES`), from the files in benchmarks/results.

    python -m benchmarks.tables            write the tables into the documents
    python -m benchmarks.tables --check    exit status 1 where a document is not what the result files say

A result file holds the rows of one command on one machine:

    {"format": 1, "table": "joint-step", "commit": "67cad1f", "command": "python -m benchmarks joint",
     "machine": "…", "rows": [{"capture": "tabletop_env", "name": "`fast`", "figures": {"seconds": 0.13}}]}

`table` says where the rows go: between `<!-- table: joint-step -->` and `<!-- end -->` of a document, or
`<!-- table: joint-step seconds -->`, which shows the named figures alone. Several files may have rows of one
table: they follow one another in the order of the files' names, and rows of one capture stand together.
`capture` may be missing. `figures` are named as in `COLUMNS`.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from benchmarks.command import run_benchmark
from neilfpp_method.data.files.json_entry import write_json
from neilfpp_method.errors import UserError

__all__ = ["COLUMNS", "Result", "Row", "filled", "markdown", "read_results", "write_result"]

ROOT = Path(__file__).parent.parent
RESULTS = Path(__file__).parent / "results"
NAMES = (
    "results.md",
    "performance.md",
    "budget.md",
    "confidence.md",
    "effects.md",
    "hosts.md",
    "light.md",
    "machines.md",
    "relighting.md",
)
DOCUMENTS = tuple(ROOT / "docs" / name for name in NAMES)
FORMAT = 1
MARKED = re.compile(r"(<!-- table: ([\w-]+)((?: \w+)*) -->\n).*?(<!-- end -->)", re.DOTALL)


@dataclass(frozen=True)
class Column:
    """How a figure is shown: the heading of its column, and the number of decimals; if None, three
    significant digits.
    """

    title: str
    decimals: int | None = 2


COLUMNS: Mapping[str, Column] = {
    "step_ms": Column("ms a step", 0),
    "kernels": Column("kernels", 0),
    "computing_ms": Column("GPU computes, ms", 1),
    "relight_psnr": Column("PSNR"),
    "relight_psnr_scaled": Column("PSNR, scale aligned"),
    "relight_psnr_linear_scaled": Column("linear radiance"),
    "relight_ssim_scaled": Column("SSIM", 3),
    "volume_psnr": Column("R"),
    "pbr_psnr": Column("PBR"),
    "volume_psnr_exposed": Column("R, exposed alike"),
    "pbr_psnr_exposed": Column("PBR, exposed alike"),
    "base_color_psnr": Column("base colour"),
    "base_color_psnr_gamma": Column("base colour, one gamma"),
    "base_color_psnr_scaled": Column("base colour scaled"),
    "roughness_psnr": Column("roughness"),
    "metallic_psnr": Column("metallic"),
    "normal_mae_deg": Column("normals °", 1),
    "chamfer": Column("Chamfer", 4),
    "incident_light_log_mae": Column("light"),
    "incident_light_log_mae_occluded": Column("light, occluded"),
    "confidence_base_color_ratio": Column("base colour"),
    "confidence_roughness_ratio": Column("roughness"),
    "confidence_metallic_ratio": Column("metallic"),
    "steps_done": Column("steps", 0),
    "peak_gb": Column("peak, GB"),
    "files_gb": Column("files of pixels, GB"),
    "planes_gb": Column("float32 planes, GB"),
    "naive_ms": Column("torch alone, ms", 0),
    "reference_ms": Column("reference, ms", 0),
    "compiled_ms": Column("compiled loops, ms", 0),
    "queries_wide": Column("queries a ray, β = 0.03", 0),
    "queries_middle": Column("β = 0.01", 0),
    "queries_sharp": Column("β = 0.003", 0),
    "rendering_speed_up": Column("rendering at β = 0.003, times faster"),
    "sdf_init": Column("SDF init", 1),
    "material_init": Column("material init", 1),
    "joint": Column("joint", 1),
    "pixels_per_yardstick": Column("pixels rendered a yardstick", 0),
    "peak_mib": Column("peak, MiB", 0),
    "seconds": Column("seconds", None),
    "speed_up": Column("times faster", None),
}
"""Every figure that a table may show, in the order of columns."""


@dataclass(frozen=True)
class Row:
    """One run: `figures` by the names in `COLUMNS`; `capture` is empty in tables that are not about
    captures.
    """

    name: str
    figures: Mapping[str, float]
    capture: str = ""


@dataclass(frozen=True)
class Result:
    """The rows of one command.

    `commit` is the measured version; in files older than this format, the version that first contained the
    figures.
    """

    table: str
    commit: str
    command: str
    machine: str
    rows: tuple[Row, ...]


def read_results(folder: Path = RESULTS) -> list[Result]:
    """Read every result file of a folder, in the order of their names.

    Raises:
        UserError: a file does not have the format of the module's docstring.
    """
    return [_read(path) for path in sorted(folder.glob("*.json"))]


def _read(path: Path) -> Result:
    try:
        content = json.loads(path.read_text("utf-8"))
        rows = tuple(
            Row(row["name"], dict(row["figures"]), row.get("capture", "")) for row in content["rows"]
        )
        result = Result(content["table"], content["commit"], content["command"], content["machine"], rows)
        format = content["format"]
    except (ValueError, KeyError, TypeError) as error:
        raise UserError(
            f"{path}: not a result file ({error!r})", "see benchmarks/tables.py for what one holds"
        ) from error
    unknown = {name for row in rows for name in row.figures} - COLUMNS.keys()
    if format != FORMAT or unknown:
        wrong = f"figures without a column: {', '.join(sorted(unknown))}" if unknown else f"format {format}"
        raise UserError(
            f"{path}: {wrong}", "add them to COLUMNS of benchmarks/tables.py, or correct the file"
        )
    return result


def write_result(path: Path, result: Result) -> None:
    """Write a result file; figures without a column are left out."""
    rows = [
        {**({"capture": row.capture} if row.capture else {}), "name": row.name}
        | {"figures": {name: row.figures[name] for name in COLUMNS if name in row.figures}}
        for row in result.rows
    ]
    head = {"format": FORMAT, "table": result.table, "commit": result.commit}
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, {**head, "command": result.command, "machine": result.machine, "rows": rows})


def markdown(results: Sequence[Result], shown: Sequence[str] = ()) -> str:
    """The rows of some results as a table in Markdown, and below it what made them. A dash: no such figure.

    Args:
        results: of one table.
        shown: names of the figures to show; none: all that there are.
    """
    rows = [(row, result.commit) for result in results for row in result.rows]
    captures = list(dict.fromkeys(row.capture for row, _ in rows))
    rows.sort(key=lambda item: captures.index(item[0].capture))
    columns = [name for name in shown or COLUMNS if any(name in row.figures for row, _ in rows)]
    head = [
        *(["capture"] if any(captures) else []),
        "",
        "version",
        *(COLUMNS[name].title for name in columns),
    ]
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    shown_capture = None
    for row, commit in rows:
        capture, shown_capture = "" if row.capture == shown_capture else row.capture, row.capture
        figures = [_cell(row.figures.get(name), COLUMNS[name].decimals) for name in columns]
        cells = [*([capture] if any(captures) else []), row.name, commit, *figures]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join([*lines, "", *_made_by(results)])


def _made_by(results: Sequence[Result]) -> list[str]:
    """One line for each command, with the versions and machines on which it ran."""
    runs: dict[str, list[str]] = {}
    for result in results:
        runs.setdefault(result.command, []).append(f"{result.commit} on {result.machine}")
    return [f"- {_code(command)}: {'; '.join(dict.fromkeys(made))}." for command, made in runs.items()]


def _cell(value: float | None, decimals: int | None) -> str:
    if value is None:
        return "–"
    if decimals is None:
        decimals = 2 if value < 10 else 1 if value < 100 else 0
    return f"{value:.{decimals}f}"


def _code(command: str) -> str:
    return command if command.startswith("none:") else f"`{command}`"


def filled(document: str, results: Sequence[Result]) -> str:
    """The document with its tables generated from the results.

    Raises:
        UserError: the document has a table without a result file.
    """

    def table(match: re.Match[str]) -> str:
        _, name, shown, _ = match.groups()
        own = [result for result in results if result.table == name]
        if not own:
            raise UserError(
                f"the table '{name}' has no result file", "run its command, or take the table out"
            )
        unknown = set(shown.split()) - COLUMNS.keys()
        if unknown:
            raise UserError(
                f"the table '{name}' has no figure '{min(unknown)}'", "see COLUMNS of benchmarks/tables.py"
            )
        return f"{match[1]}{markdown(own, shown.split())}\n{match[4]}"

    return MARKED.sub(table, document)


@dataclass
class Options:
    """Write the tables of the documents, from the result files."""

    check: bool = False
    """Write nothing; end with status 1 where a document is not what the result files say."""


def main(options: Options) -> int:
    """Write or check the tables. Returns the exit status."""
    results = read_results()
    stale = 0
    for path in DOCUMENTS:
        before = path.read_text("utf-8")
        after = filled(before, results)
        if after != before and options.check:
            print(f"{path.relative_to(ROOT)}: not what the result files say; run python -m benchmarks.tables")
            stale = 1
        elif after != before:
            path.write_text(after, "utf-8")
            print(f"{path.relative_to(ROOT)}: tables written")
    return stale


if __name__ == "__main__":
    run_benchmark(lambda: main(tyro.cli(Options)))
