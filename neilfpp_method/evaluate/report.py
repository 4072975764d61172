"""The report of a run: one HTML file that holds its pictures and explains its figures, and a contact sheet.

Both show the same: views of the run beside the truth where it is at hand, and the light that arrives at four points.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from neilfpp_method.data.images import replacing, write_png
from neilfpp_method.evaluate.confidence import gather_evidence, with_deviation
from neilfpp_method.evaluate.page import Figure, report_page
from neilfpp_method.evaluate.panels import albedo_scale, light_sections, view_sections
from neilfpp_method.evaluate.pictures import contact_sheet
from neilfpp_method.evaluate.views import RenderedView, known_test_views, render_view
from neilfpp_method.schedule import stage_steps
from neilfpp_method.train.health_record import in_words as in_words_of_health
from neilfpp_method.train.health_record import read_findings
from neilfpp_method.train.light_record import in_words, read_fits
from neilfpp_method.train.run import Run, read_json

__all__ = ["write_light_picture", "write_report"]

SHOWN_VIEWS = 3
CONFIDENCE_STEP = 2
"""One pixel in so many by so many is asked how far off it may be."""

VIEWS_CAPTION = (
    "Views that were not trained on, where the capture holds any out. An error is the difference of the two pictures "
    "beside it, averaged over their channels; for normals it is the angle between them. Maps with ± say, without the truth, "
    "how far off the material may be, judged by what the training views saw of each point."
)
LIGHT_CAPTION = (
    "The light that arrives at four points of the surface, all directions unrolled: +z of the scene at the top, the "
    "azimuth from left to right. Directions below the surface are left blank. One exposure for all. Rings are about the "
    "lamps that were found. Positions are in the scene frame, where the object has radius 1."
)


def write_report(
    run: Run,
    out_dir: Path,
    metrics: Mapping[str, float],
    timing: Mapping[str, float],
    rendered: Sequence[RenderedView] = (),
) -> Path:
    """Write `report.html` and `contact_sheet.png`.

    Args:
        run: the run; up to three of its test views are rendered, of its training views where none is held out.
        out_dir: the folder to write.
        metrics: figures by name, as `protocols.evaluate` gives them.
        timing: seconds of each stage.
        rendered: views that somebody has rendered already; the others are rendered here.

    Returns:
        The path of the report.
    """
    shown = _with_shown_views(run)
    at_hand = {view.name: view for view in rendered}
    rendered = [at_hand.get(view.name) or render_view(run, run.capture.views.index(view)) for view in shown.capture.test_views]
    known = known_test_views(shown, rendered).views
    scale = albedo_scale(rendered, known) if run.has_material else None
    if run.has_material and run.capture.train_views:
        evidence = gather_evidence(run)
        rendered = [with_deviation(run, evidence, view, CONFIDENCE_STEP) for view in rendered]
    views = view_sections(shown, rendered, known, scale)
    light = light_sections(shown, rendered, scale) if run.has_material else []

    title = f"{run.capture.root.resolve().name}, {run.config.preset}"
    subtitle = f"step {run.step} of {sum(stage_steps(run.config.train).values())}"
    write_png(out_dir / "contact_sheet.png", contact_sheet(title, subtitle, [*views, *light]))
    figures = [Figure("Views", VIEWS_CAPTION, contact_sheet("", "", views))]
    figures += [Figure("Incident light", LIGHT_CAPTION, contact_sheet("", "", light))] if light else []
    path = out_dir / "report.html"
    with replacing(path) as temporary:
        temporary.write_text(report_page(title, subtitle, figures, metrics, timing, _facts(run)), encoding="utf-8")
    return path


def write_light_picture(run: Run, path: Path) -> bool:
    """Write the report's pictures of incident light alone, as a PNG. Returns whether the run has any to show."""
    if not run.has_material:
        return False
    shown = _with_shown_views(run)
    rendered = [render_view(run, run.capture.views.index(view)) for view in shown.capture.test_views]
    scale = albedo_scale(rendered, known_test_views(shown, rendered).views)
    sections = light_sections(shown, rendered, scale)
    if sections:
        write_png(path, contact_sheet("", "", sections))
    return bool(sections)


def _with_shown_views(run: Run) -> Run:
    """The run with up to three views held out, spread over those that are, or over the training views where none is."""
    views = run.capture.test_views or run.capture.train_views
    rows = np.linspace(0, len(views) - 1, SHOWN_VIEWS).round().astype(int)
    return replace(run, capture=replace(run.capture, test=frozenset(views[row].name for row in rows)))


def _facts(run: Run) -> dict[str, str]:
    """What made the run: capture, settings and machine, in words."""
    shading, train = run.config.shading, run.config.train
    facts = {
        "Capture": run.capture.summary,
        "Preset": run.config.preset,
        "Shading": f"{shading.lobe} lobe, {shading.sampler} sampler, {shading.train_samples} directions a point in "
        f"training and {shading.eval_samples} here",
        "Inter-reflection": run.config.inter_reflection.mode,
        "Light": in_words(run.config.light, read_fits(run.path, run.step)),
        "Rays a step": str(train.rays),
    }
    findings = read_findings(run.path)
    if findings is not None:
        facts["Health"] = in_words_of_health(findings)
    path = run.path / "environment.json"
    if path.is_file():
        machine = read_json(path)
        facts["Processor"] = f"{machine.get('processor')}, {machine.get('cores')} cores, {machine.get('threads')} threads"
        facts["GPU"] = ", ".join(machine.get("gpus", [])) or "none"
        facts["Versions"] = ", ".join(f"{name} {version}" for name, version in machine.get("packages", {}).items())
    return facts
