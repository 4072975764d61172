"""Write the report of a run, `report.html`: one self-contained file."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from neilfpp_method.data.files.atomic_file import replacing
from neilfpp_method.errors import UserError
from neilfpp_method.report import pictures, tables
from neilfpp_method.report.data_urls import image_url
from neilfpp_method.report.files import RunFiles, changed_settings, read_files
from neilfpp_method.report.light import lamps_of, picture_of_map
from neilfpp_method.report.markup import Html, element, joined
from neilfpp_method.report.measured import OWN, Measured, count_of_views
from neilfpp_method.report.page import PageSection, page
from neilfpp_method.report.surface import packed_surface
from neilfpp_method.report.views import (
    MAX_SIZE,
    MAX_VIEWS,
    MIN_SIZE,
    ReportViews,
    encode_views,
    run_for_display,
)
from neilfpp_method.train.checkpoint import last_checkpoint
from neilfpp_method.train.light_record import light_summary, read_fits
from neilfpp_method.train.run import Run, load_run

__all__ = ["REPORT", "ReportOptions", "write_report"]

REPORT = "report.html"
RENDERING_SHARE = 0.85
"""Fraction of the progress that rendering the views takes."""
BEFORE_CHECKPOINT = "Training was stopped before its first checkpoint"
"""The reason why a report has no images."""


@dataclass(frozen=True)
class ReportOptions:
    """What a report contains.

    Attributes:
        views: number of views.
        size: longest side of a view, pixels.
        confidence: whether expected errors of the material are included.
    """

    views: int = 2
    size: int = 320
    confidence: bool = False

    def check(self) -> None:
        """Raise a `UserError` if a number is out of range."""
        if not 1 <= self.views <= MAX_VIEWS:
            raise UserError(f"a report cannot have {self.views} views", f"give 1 to {MAX_VIEWS} with --views")
        if not MIN_SIZE <= self.size <= MAX_SIZE:
            raise UserError(
                f"views in a report cannot have {self.size} pixels",
                f"give {MIN_SIZE} to {MAX_SIZE} with --size",
            )


def write_report(
    path: Path,
    out: Path,
    options: ReportOptions = ReportOptions(),
    device: str = "cpu",
    on_progress: Callable[[float], None] = lambda share: None,
    say: Callable[[str], None] = lambda text: None,
) -> Path:
    """Write the report of a run atomically.

    Args:
        path: the run's folder. A run that was stopped before its first checkpoint gets a report without
            images.
        out: the file to write.
        options: what the report contains.
        device: device on which views are rendered.
        on_progress: called with the fraction of the work that is done.
        say: receives one line if the report has no images.

    Returns:
        `out`.

    Raises:
        UserError: there is no run, or nothing is known of it except its settings; its capture was moved, an
            option is out of range, or the file cannot be written.
    """
    options.check()
    files = read_files(path)
    run = load_run(path, device) if last_checkpoint(path).is_file() else None
    if run is None and not files.has_results:
        raise UserError(f"{path}: nothing to report. {BEFORE_CHECKPOINT}", _how_to_continue(path))
    text = _without_model(files) if run is None else _with_model(run, files, options, on_progress)
    with replacing(out) as temporary:
        temporary.write_text(text, encoding="utf-8")
    on_progress(1.0)
    if run is None:
        say(f"the report has no views, surface and light. {BEFORE_CHECKPOINT}. {_how_to_continue(path)}")
    return out


def _with_model(
    run: Run, files: RunFiles, options: ReportOptions, on_progress: Callable[[float], None]
) -> str:
    small = run_for_display(run, options.views, options.size)
    views = encode_views(small, options.confidence, lambda share: on_progress(RENDERING_SHARE * share))
    light = (
        light_summary(run.config.light, read_fits(run.path, run.step))
        if run.has_material
        else "no light has been estimated yet"
    )
    sections = [
        PageSection("health", "Health", tables.health_section(files.findings, list(_notes(run, files)))),
        PageSection("views", "Views", pictures.views_section(views, bool(run.capture.test_views))),
        PageSection("surface", "Surface", _surface(small)),
        PageSection(
            "light", "Light", pictures.light_section(light, picture_of_map(run), lamps_of(run), views.light)
        ),
        PageSection("figures", "Figures", _figures(run, files, views)),
        *_from_files(files),
        PageSection("reading", "How to read this", tables.reading_section()),
        PageSection(
            "facts", "Setup", tables.facts_section({"Capture": run.capture.summary, **_facts(files)})
        ),
    ]
    title = f"{run.capture.root.resolve().name}, {run.config.preset}"
    return page(title, f"step {run.step} of {files.steps}", sections)


def _surface(run: Run) -> Html:
    """The surface in a viewer, or the reason why there is none."""
    try:
        return pictures.surface_section(packed_surface(run))
    except UserError as error:
        return element("p", f"There is no surface to show: {error.problem}.")


def _notes(run: Run, files: RunFiles) -> Iterator[str]:
    """What the reader should know first: what is missing in the run or its capture, and damaged files."""
    if run.step < files.steps:
        stopped = f"Training was stopped after step {run.step} of {files.steps}."
        yield f"{stopped} {_how_to_continue(run.path)}"
    yield from files.notes
    if not run.has_material:
        yield "No stage has estimated material and light yet; only the geometry is shown."
    if not run.capture.hdr:
        yield (
            "The photographs contain display values (LDR): values brighter than white are clipped, so light "
            "and metallic are underestimated."
        )
    if not run.capture.test_views:
        yield (
            "No view is held out for testing, so the quality of new views is not measured. To measure it, "
            "train with --test-every 8."
        )


def _without_model(files: RunFiles) -> str:
    note = f"{BEFORE_CHECKPOINT}. {_how_to_continue(files.path)}"
    sections = [
        PageSection("health", "Health", tables.health_section(files.findings, [note, *files.notes])),
        *_from_files(files),
        PageSection("facts", "Setup", tables.facts_section(_facts(files))),
    ]
    return page(f"{files.path.resolve().name}, {files.config.preset}", f"step 0 of {files.steps}", sections)


def _how_to_continue(path: Path) -> str:
    return f"To continue: neilfpp train --out {path} --resume"


def _from_files(files: RunFiles) -> list[PageSection]:
    settings = tables.settings_section(files.config.preset, changed_settings(files.config))
    previews = {stage: image_url(pixels) for stage, pixels in files.previews.items()}
    time = tables.time_section(files.seconds, files.work, files.checks, previews)
    return [
        PageSection("time", "Time", time),
        PageSection("effects", "Effects", tables.effects_section(files.effects)),
        PageSection("settings", "Settings", settings),
    ]


def _figures(run: Run, files: RunFiles, views: ReportViews) -> Html:
    """Tables of figures, one per protocol; if none was measured, the figures of the views in the report."""
    if files.measured:
        sections = (
            joined(
                element("h3", f"Protocol {measured.protocol}"),
                tables.figures_section(measured.figures, _description(measured)),
            )
            for measured in files.measured.values()
        )
        return joined(*sections)
    if not run.capture.test_views:
        return element("p", "Nothing was measured, because no view is held out.")
    if not views.figures:
        return element("p", "Nothing was measured, because the views in this report show no surface.")
    description = (
        f"These figures are of the views in this report: {count_of_views(len(views.names))} of "
        f"{views.width}×{views.height} pixels. They are not the figures of the protocol neilfpp, which "
        f"`neilfpp eval {run.path}` measures."
    )
    return tables.figures_section(views.figures, description)


def _description(measured: Measured) -> str:
    """How figures were measured, in one or two sentences."""
    option = "" if measured.protocol == OWN else f" --protocol {measured.protocol}"
    parts = [measured.extent] if measured.extent else []
    parts += [f"{name.replace('_', ' ')}: {text}" for name, text in measured.description.items()]
    details = f": {'; '.join(parts)}" if parts else ""
    outdated = " The figures are older than the checkpoint of this report." if measured.outdated else ""
    return f"Measured by `neilfpp eval{option}`{details}.{outdated}"


def _facts(files: RunFiles) -> dict[str, str]:
    """Settings and hardware for display, by title."""
    shading, machine = files.config.shading, files.machine
    facts = {
        "Preset": files.config.preset,
        "Shading": (
            f"{shading.lobe} lobe, {shading.sampler} sampler; directions per point: "
            f"{shading.train_samples} in training, {shading.eval_samples} in this report"
        ),
        "Inter-reflection": files.config.light.inter_reflection,
        "Rays per step": str(files.config.train.rays),
    }
    if machine:
        facts["Processor"] = (
            f"{machine.get('processor')}, {machine.get('cores')} cores, {machine.get('threads')} threads"
        )
        facts["GPU"] = ", ".join(files.gpus) or "none"
        packages = machine.get("packages")
        versions = packages.items() if isinstance(packages, dict) else ()
        facts["Versions"] = ", ".join(f"{name} {version}" for name, version in versions)
    return facts
