"""`report.html` of a run: one file that holds all that it shows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from neilfpp_method.data.images import read_image, replacing
from neilfpp_method.errors import UserError
from neilfpp_method.report import pictures, tables
from neilfpp_method.report.encoded import encoded
from neilfpp_method.report.files import Files, changed_settings, read_files
from neilfpp_method.report.light import lamps_of, picture_of_map
from neilfpp_method.report.markup import Html, element, joined
from neilfpp_method.report.measured import OWN, Measured
from neilfpp_method.report.page import page
from neilfpp_method.report.surface import packed_surface
from neilfpp_method.report.views import Shown, show_views, shown_run
from neilfpp_method.schedule import Stage
from neilfpp_method.train.light_record import in_words, read_fits
from neilfpp_method.train.run import Run, load_run

__all__ = ["REPORT", "ReportOptions", "write_report"]

REPORT = "report.html"
VIEWS_SHARE = 0.85
"""Of the work that rendering the views is."""


@dataclass(frozen=True)
class ReportOptions:
    """How much a page shows: views, longest side of a picture in pixels, and expected errors or not."""

    views: int = 2
    size: int = 320
    confidence: bool = False

    def check(self) -> None:
        """Raises a `UserError` where a number is out of range."""
        if not 1 <= self.views <= 64:
            raise UserError(f"a page of {self.views} views", "give 1 to 64 with --views")
        if not 16 <= self.size <= 2048:
            raise UserError(f"pictures of {self.size} pixels", "give 16 to 2048 with --size")


def write_report(
    path: Path,
    out: Path,
    options: ReportOptions = ReportOptions(),
    device: str = "cpu",
    on_progress: Callable[[float], None] = lambda share: None,
) -> Path:
    """Write the page of a run, whole or not at all.

    Args:
        path: the run's folder; a run that was stopped before its first checkpoint has a page of what is
            there.
        out: the file.
        options: how much it shows.
        device: where to render.
        on_progress: told the share that is done.

    Raises:
        UserError: no run there, its capture has moved, an option out of range, or a file that cannot be
            written.
    """
    options.check()
    files = read_files(path)
    run = load_run(path, device) if (path / "checkpoints" / "last.pt").is_file() else None
    text = _without_model(files) if run is None else _with_model(run, files, options, on_progress)
    with replacing(out) as temporary:
        temporary.write_text(text, encoding="utf-8")
    on_progress(1.0)
    return out


def _with_model(run: Run, files: Files, options: ReportOptions, on_progress: Callable[[float], None]) -> str:
    small = shown_run(run, options.views, options.size)
    shown = show_views(small, options.confidence, lambda share: on_progress(VIEWS_SHARE * share))
    try:
        surface, reason = packed_surface(small), ""
    except UserError as error:
        surface, reason = None, error.problem
    notes = list(files.notes)
    if run.step < files.steps:
        go_on = f"neilfpp train --out {run.path} --resume"
        notes.insert(
            0, f"Training was stopped after step {run.step} of {files.steps}; it goes on with: {go_on}"
        )
    if not run.has_material:
        notes.append("No stage has moved the material and the light yet, so there is geometry alone.")
    if not run.capture.hdr:
        notes.append(
            "The photographs are display values (LDR): what is brighter than white is lost, and light and "
            "metallic come out low."
        )
    if not run.capture.test_views:
        notes.append(
            "No view is held out for testing: nothing here says how new views look. Train with --test-every "
            "8 to know."
        )
    words = (
        in_words(run.config.light, read_fits(run.path, run.step))
        if run.has_material
        else "no light has been estimated yet"
    )
    sections = [
        ("health", "Health", tables.health_section(files.findings, notes)),
        ("views", "Views", pictures.views_section(shown, bool(run.capture.test_views))),
        ("surface", "Surface", pictures.surface_section(surface, reason)),
        ("light", "Light", pictures.light_section(words, picture_of_map(run), lamps_of(run), shown.light)),
        ("figures", "Figures", _figures(run, files, shown)),
        *_from_files(files),
        ("reading", "How to read this", tables.reading_section()),
        ("facts", "What made it", tables.facts_section({"Capture": run.capture.summary, **_facts(files)})),
    ]
    title = f"{run.capture.root.resolve().name}, {run.config.preset}"
    return page(title, f"step {run.step} of {files.steps}", sections)


def _without_model(files: Files) -> str:
    go_on = f"neilfpp train --out {files.path} --resume"
    note = f"Training was stopped before its first checkpoint: nothing to show yet. It goes on with: {go_on}"
    sections = [
        ("health", "Health", tables.health_section(files.findings, [note, *files.notes])),
        *_from_files(files),
        ("facts", "What made it", tables.facts_section(_facts(files))),
    ]
    return page(f"{files.path.resolve().name}, {files.config.preset}", f"step 0 of {files.steps}", sections)


def _from_files(files: Files) -> list[tuple[str, str, Html]]:
    return [
        ("time", "Time", tables.time_section(files.timing, files.work, files.looks, _previews(files.path))),
        ("effects", "Effects", tables.effects_section(files.effects)),
        (
            "settings",
            "Settings",
            tables.settings_section(files.config.preset, changed_settings(files.config)),
        ),
    ]


def _figures(run: Run, files: Files, shown: Shown) -> Html:
    """Figures by protocol, each with how they came about; without any those of the views that are shown."""
    if files.measured:
        tables_of = (
            joined(
                element("h3", f"Protocol {measured.protocol}"),
                tables.figures_section(measured.figures, _told(measured)),
            )
            for measured in files.measured.values()
        )
        return joined(*tables_of)
    if not run.capture.test_views:
        return tables.figures_section({}, "Nothing was measured: no view is held out.")
    size = f"{len(shown.names)} views shown here, of {shown.width}×{shown.height} pixels"
    said = (
        f"Of the {size}, not yet the figures of the protocol neilfpp: `neilfpp eval {run.path}` measures "
        "those."
    )
    return tables.figures_section(shown.figures, said)


def _told(measured: Measured) -> str:
    """How figures came about, in words."""
    option = "" if measured.protocol == OWN else f" --protocol {measured.protocol}"
    parts = [measured.extent] if measured.extent else []
    parts += [f"{name.replace('_', ' ')}: {text}" for name, text in measured.said.items()]
    late = " They are older than the checkpoint that is shown here." if measured.outdated else ""
    return (
        f"By `neilfpp eval{option}`: {'; '.join(parts)}.{late}"
        if parts
        else f"By `neilfpp eval{option}`.{late}"
    )


def _previews(path: Path) -> list[tuple[str, str]]:
    """The pictures at the ends of stages, as data addresses."""
    found = []
    for stage in Stage:
        file = path / "previews" / f"{stage.value}.png"
        if file.is_file():
            found.append((stage.value, encoded((read_image(file).pixels * 255).round().astype(np.uint8))))
    return found


def _facts(files: Files) -> dict[str, str]:
    """Settings and machine, in words."""
    shading, machine = files.config.shading, files.machine
    facts = {
        "Preset": files.config.preset,
        "Shading": (
            f"{shading.lobe} lobe, {shading.sampler} sampler, {shading.train_samples} directions a point in "
            f"training and {shading.eval_samples} here"
        ),
        "Inter-reflection": files.config.inter_reflection.mode,
        "Rays a step": str(files.config.train.rays),
    }
    if machine:
        facts["Processor"] = (
            f"{machine.get('processor')}, {machine.get('cores')} cores, {machine.get('threads')} threads"
        )
        facts["GPU"] = ", ".join(map(str, machine.get("gpus") or [])) or "none"
        packages = machine.get("packages")
        named = packages.items() if isinstance(packages, dict) else ()
        facts["Versions"] = ", ".join(f"{name} {version}" for name, version in named)
    return facts
