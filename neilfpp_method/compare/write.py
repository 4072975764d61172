"""`neilfpp compare`: runs side by side, as a table and a picture.

<out>/compare.json    what the table holds, with its notes
<out>/compare.csv     the same, a line for each row
<out>/compare.png     the same views of all runs beside the truth
"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from neilfpp_method.compare.common import Common, capture_to_show, common_views
from neilfpp_method.compare.contenders import Contender, read_contenders
from neilfpp_method.compare.figures import SHOWN, figure_rows, figures_parts
from neilfpp_method.compare.parts import Part, runs_part, seconds_part, settings_part
from neilfpp_method.compare.sheet import Column, comparison_sheet
from neilfpp_method.data.images import replacing, write_png
from neilfpp_method.errors import UserError
from neilfpp_method.report.views import Looked, look_at_views
from neilfpp_method.train.run import check_writable, load_run, write_json

__all__ = ["FILES", "Comparison", "compare_runs"]

FILES = ("compare.json", "compare.csv", "compare.png")
FORMAT = 1


@dataclass(frozen=True)
class Comparison:
    """A table and what is to be known of it: a label for each run, parts, notes, and the files."""

    labels: tuple[str, ...]
    parts: tuple[Part, ...]
    notes: tuple[str, ...]
    files: tuple[Path, ...]


def compare_runs(
    paths: Sequence[Path],
    out: Path,
    views: int,
    size: int,
    device: str,
    on_progress: Callable[[float], None] = lambda share: None,
) -> Comparison:
    """Compare runs, and write table and picture.

    Args:
        paths: the runs' folders; the first is what the others are compared with.
        out: the folder to write.
        views: how many views the picture shows; 0: no picture, and nothing is rendered.
        size: pixels of the longest side of a rendered view.
        device: where to render.
        on_progress: told the share that is done.

    Raises:
        UserError: something that is no run, an option out of range, or a place that cannot be written;
            nothing is written then.
    """
    if not 0 <= views <= 64:
        raise UserError(f"a picture of {views} views", "give 0 to 64 with --views")
    if not 16 <= size <= 2048:
        raise UserError(f"pictures of {size} pixels", "give 16 to 2048 with --size")
    check_writable(out / FILES[0])
    runs = read_contenders(paths)
    common = common_views(runs, views, size)
    looked = _look(runs, common, device, on_progress) if common.names else {}
    parts = [runs_part(runs), settings_part(runs), *figures_parts(runs, common.apart)]
    if looked:
        parts.append(_shown_part(runs, common, looked))
    parts.append(seconds_part(runs))
    found = Comparison(tuple(run.label for run in runs), tuple(parts), common.notes, ())
    return replace(found, files=_write(found, out, common, runs, looked))


def _look(
    runs: Sequence[Contender], common: Common, device: str, on_progress: Callable[[float], None]
) -> dict[int, Looked]:
    """What each run shows of the common views, by its number; one model at a time is in memory."""
    shown = [i for i, run in enumerate(runs) if run.has_model]
    found = {}
    for k, i in enumerate(shown):
        run = load_run(runs[i].path, device)
        run = replace(run, capture=capture_to_show(run.capture, common))
        found[i] = look_at_views(run, False, lambda share, k=k: on_progress((k + share) / len(shown)))
    return found


def _shown_part(runs: Sequence[Contender], common: Common, looked: Mapping[int, Looked]) -> Part:
    """Figures of the views in the picture: the same views at the same size for all runs."""
    rows = figure_rows([looked[i].figures if i in looked else {} for i in range(len(runs))])
    sources = {look.mask_source for look in looked.values()}
    notes = []
    if len(sources) > 1 or "rendered opacity" in sources:
        notes.append(
            "the capture does not say which pixels show the object, so each run counts those that it renders "
            "as opaque; masks in the capture make that equal"
        )
    seen = "" if common.held_out else ", learned from"
    many = f"{len(common.names)} views" if len(common.names) != 1 else "one view"
    title = f"The picture's {many}, sides up to {common.longest} pixels{seen}"
    return Part("figures", SHOWN, title, rows, notes=tuple(notes))


# ------------------------------------------------------------------------------------------------------ files


def _write(
    found: Comparison, out: Path, common: Common, runs: Sequence[Contender], looked: Mapping[int, Looked]
) -> tuple[Path, ...]:
    files = [out / name for name in FILES]
    if looked:
        columns = [Column(runs[i].label, look.maps) for i, look in looked.items()]
        title = f"{runs[0].capture.root.resolve().name}: {len(runs)} runs"
        write_png(files[2], comparison_sheet(title, common.names, columns))
    else:
        files[2].unlink(missing_ok=True)  # of an earlier comparison, which the table would not belong to
    write_json(files[0], _plain(found, common))
    with replacing(files[1]) as temporary:
        temporary.write_text(_csv(found), encoding="utf-8")
    return tuple(files if looked else files[:2])


def _plain(found: Comparison, common: Common) -> dict[str, Any]:
    """The table as plain values; numbers as they are, without rounding."""
    parts = [
        {
            "kind": part.kind,
            "name": part.name,
            "title": part.title,
            "notes": list(part.notes),
            "apart": [found.labels[i] for i in sorted(part.apart)],
            "rows": {
                row.key: {
                    "title": row.title,
                    "better": row.better,
                    "values": dict(zip(found.labels, row.values, strict=True)),
                }
                for row in part.rows
            },
        }
        for part in found.parts
    ]
    return {
        "format": FORMAT,
        "runs": list(found.labels),
        "views": list(common.names),
        "notes": list(found.notes),
        "parts": parts,
    }


def _csv(found: Comparison) -> str:
    """A line for each row: kind, which protocol, key, and a value for each run.

    The line `comparable` of figures says whether they may be compared with the first run's.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["kind", "name", "key", *found.labels])
    for part in found.parts:
        if part.kind == "figures":
            apart = ["no" if i in part.apart else "yes" for i in range(len(found.labels))]
            writer.writerow([part.kind, part.name, "comparable", *apart])
        for row in part.rows:
            values = ["" if value is None else value for value in row.values]
            writer.writerow([part.kind, part.name, row.key, *values])
    return text.getvalue()
