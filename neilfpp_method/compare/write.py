"""`neilfpp compare`: compare runs in a table and an image.

Files:

    <out>/compare.json    the table with its notes
    <out>/compare.csv     the table, one line per row
    <out>/compare.png     the same views of all runs beside the truth
"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from neilfpp_method.compare.common import CommonViews, capture_to_show, common_views
from neilfpp_method.compare.figures import SHOWN, figure_rows, figures_parts
from neilfpp_method.compare.parts import TablePart, runs_part, seconds_part, settings_part
from neilfpp_method.compare.runs import ComparedRun, read_compared_runs
from neilfpp_method.compare.sheet import Column, comparison_sheet
from neilfpp_method.data.files.atomic_file import replacing
from neilfpp_method.data.files.images import write_png
from neilfpp_method.data.files.json_entry import write_json
from neilfpp_method.errors import UserError
from neilfpp_method.report.measured import count_of_views
from neilfpp_method.report.views import MAX_SIZE, MAX_VIEWS, MIN_SIZE, ComparedViews, compare_views
from neilfpp_method.train.output import check_writable
from neilfpp_method.train.run import load_run

__all__ = ["FILES", "RunComparison", "compare_runs"]

FILES = ("compare.json", "compare.csv", "compare.png")
FORMAT = 1
"""Version of the format of compare.json."""


@dataclass(frozen=True)
class RunComparison:
    """The result of a comparison: a label per run, the parts of the table, notes, and the files written."""

    labels: tuple[str, ...]
    parts: tuple[TablePart, ...]
    notes: tuple[str, ...]
    files: tuple[Path, ...]


def compare_runs(
    paths: Sequence[Path],
    out: Path,
    views: int,
    size: int,
    device: str,
    on_progress: Callable[[float], None] = lambda share: None,
) -> RunComparison:
    """Compare runs, and write the table and the image.

    Args:
        paths: folders of the runs. The first run is the reference.
        out: the folder to write.
        views: number of views in the image; if 0, nothing is rendered and no image is written.
        size: longest side of a rendered view, pixels.
        device: device on which views are rendered.
        on_progress: called with the fraction of the work that is done.

    Raises:
        UserError: a folder is not a run, an option is out of range, or the output cannot be written. In these
            cases nothing is written.
    """
    if not 0 <= views <= MAX_VIEWS:
        raise UserError(f"cannot show {views} views in one image", f"give 0 to {MAX_VIEWS} with --views")
    if not MIN_SIZE <= size <= MAX_SIZE:
        raise UserError(f"cannot render views of {size} pixels", f"give {MIN_SIZE} to {MAX_SIZE} with --size")
    check_writable(out / FILES[0])
    runs = read_compared_runs(paths)
    common = common_views(runs, views, size)
    rendered = _render(runs, common, device, on_progress) if common.names else {}
    parts = [runs_part(runs), settings_part(runs), *figures_parts(runs, common.other_capture)]
    if rendered:
        parts.append(_rendered_part(runs, common, rendered))
    parts.append(seconds_part(runs))
    comparison = RunComparison(tuple(run.label for run in runs), tuple(parts), common.notes, ())
    return replace(comparison, files=_write(comparison, out, common, runs, rendered))


def _render(
    runs: Sequence[ComparedRun], common: CommonViews, device: str, on_progress: Callable[[float], None]
) -> dict[int, ComparedViews]:
    """Render the common views of each run that has a model, by index; one model is in memory at a time."""
    with_model = [i for i, run in enumerate(runs) if run.has_model]
    rendered = {}
    for k, i in enumerate(with_model):
        run = load_run(runs[i].path, device)
        run = replace(run, capture=capture_to_show(run.capture, common))
        rendered[i] = compare_views(run, False, lambda share, k=k: on_progress((k + share) / len(with_model)))
    return rendered


def _rendered_part(
    runs: Sequence[ComparedRun], common: CommonViews, rendered: Mapping[int, ComparedViews]
) -> TablePart:
    """Figures of the views in the image: the same views at the same size for all runs."""
    rows = figure_rows([rendered[i].figures if i in rendered else {} for i in range(len(runs))])
    sources = {views.mask_source for views in rendered.values()}
    notes = []
    if len(sources) > 1 or "rendered opacity" in sources:
        notes.append(
            "the capture has no masks, so each run counts the pixels that it renders as opaque; masks in the "
            "capture would make all runs count the same pixels"
        )
    trained = "" if common.held_out else ", used in training"
    title = f"The image's {count_of_views(len(common.names))}, longest side {common.longest} pixels{trained}"
    return TablePart("figures", SHOWN, title, rows, notes=tuple(notes))


# ------------------------------------------------------------------------------------------------------ files


def _write(
    comparison: RunComparison,
    out: Path,
    common: CommonViews,
    runs: Sequence[ComparedRun],
    rendered: Mapping[int, ComparedViews],
) -> tuple[Path, ...]:
    json_file, csv_file, image_file = (out / name for name in FILES)
    if rendered:
        columns = [Column(runs[i].label, views.maps) for i, views in rendered.items()]
        title = f"{runs[0].capture.root.resolve().name}: {len(runs)} runs"
        write_png(image_file, comparison_sheet(title, common.names, columns))
    else:
        # The image of an earlier comparison would not match the new table.
        image_file.unlink(missing_ok=True)
    write_json(json_file, _plain(comparison, common))
    with replacing(csv_file) as temporary:
        temporary.write_text(_csv(comparison), encoding="utf-8")
    return (json_file, csv_file, image_file) if rendered else (json_file, csv_file)


def _plain(comparison: RunComparison, common: CommonViews) -> dict[str, Any]:
    """The table as plain values for JSON; numbers are not rounded."""
    parts = [
        {
            "kind": part.kind,
            "name": part.name,
            "title": part.title,
            "notes": list(part.notes),
            "apart": [comparison.labels[i] for i in sorted(part.not_comparable)],
            "rows": {
                row.key: {
                    "title": row.title,
                    "better": row.better,
                    "values": dict(zip(comparison.labels, row.values, strict=True)),
                }
                for row in part.rows
            },
        }
        for part in comparison.parts
    ]
    return {
        "format": FORMAT,
        "runs": list(comparison.labels),
        "views": list(common.names),
        "notes": list(comparison.notes),
        "parts": parts,
    }


def _csv(comparison: RunComparison) -> str:
    """The table as CSV: one line per row with kind, protocol, key, and a value for each run.

    In a part of figures, the line `comparable` says whether they can be compared with the first run's.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["kind", "name", "key", *comparison.labels])
    for part in comparison.parts:
        if part.kind == "figures":
            answers = ["no" if i in part.not_comparable else "yes" for i in range(len(comparison.labels))]
            writer.writerow([part.kind, part.name, "comparable", *answers])
        for row in part.rows:
            values = ["" if value is None else value for value in row.values]
            writer.writerow([part.kind, part.name, row.key, *values])
    return text.getvalue()
