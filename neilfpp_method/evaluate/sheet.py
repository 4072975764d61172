"""Write a contact sheet of a run beside the truth, and images of its incident light."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from neilfpp_method.data.files.images import write_png
from neilfpp_method.evaluate.confidence import DISPLAY_STEP, measure_residuals, with_deviation
from neilfpp_method.evaluate.contact_sheet import contact_sheet
from neilfpp_method.evaluate.light_panels import light_sections
from neilfpp_method.evaluate.panels import albedo_scale, view_sections
from neilfpp_method.evaluate.views import RenderedView, evenly_spread, known_test_views, render_view
from neilfpp_method.schedule import total_steps
from neilfpp_method.train.run import Run

__all__ = ["write_contact_sheet", "write_light_picture"]

SHOWN_VIEWS = 3
"""Number of views on a contact sheet."""


def write_contact_sheet(run: Run, path: Path, rendered: Sequence[RenderedView] = ()) -> None:
    """Write a PNG that shows up to three views of a run, and the incident light at four points.

    Args:
        run: the run. Its test views are shown, or its training views if no view is held out.
        path: the file to write.
        rendered: views that were rendered before; any other view is rendered here.
    """
    displayed = _with_displayed_views(run)
    by_name = {view.name: view for view in rendered}
    rendered = [
        by_name.get(view.name) or render_view(run, run.capture.views.index(view))
        for view in displayed.capture.test_views
    ]
    known = known_test_views(displayed, rendered).views
    scale = albedo_scale(rendered, known) if run.has_material else None
    if run.has_material and run.capture.train_views:
        residuals = measure_residuals(run)
        rendered = [with_deviation(run, residuals, view, DISPLAY_STEP) for view in rendered]
    views = view_sections(displayed, rendered, known, scale)
    light = light_sections(displayed, rendered, scale) if run.has_material else []
    title = f"{run.capture.root.resolve().name}, {run.config.preset}"
    subtitle = f"step {run.step} of {total_steps(run.config.train)}"
    write_png(path, contact_sheet(title, subtitle, [*views, *light]))


def write_light_picture(run: Run, path: Path) -> bool:
    """Write a PNG with images of the incident light. Returns False, and writes nothing, if there are none."""
    if not run.has_material:
        return False
    displayed = _with_displayed_views(run)
    rendered = [render_view(run, run.capture.views.index(view)) for view in displayed.capture.test_views]
    scale = albedo_scale(rendered, known_test_views(displayed, rendered).views)
    sections = light_sections(displayed, rendered, scale)
    if sections:
        write_png(path, contact_sheet("", "", sections))
    return bool(sections)


def _with_displayed_views(run: Run) -> Run:
    """The run with up to three test views, chosen evenly from its test views or else its training views."""
    views = run.capture.test_views or run.capture.train_views
    names = evenly_spread([view.name for view in views], SHOWN_VIEWS)
    return replace(run, capture=replace(run.capture, test=frozenset(names)))
