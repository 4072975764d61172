"""Render views of a run for reports and comparisons: all maps, beside the truth if it is known."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from neilfpp_method.data.scaling import at_scale, file_size
from neilfpp_method.evaluate.confidence import DISPLAY_STEP, measure_residuals, with_deviation
from neilfpp_method.evaluate.contact_sheet import Section
from neilfpp_method.evaluate.light_panels import light_sections
from neilfpp_method.evaluate.map_metrics import image_metrics, material_metrics, normal_metrics
from neilfpp_method.evaluate.panels import ComparedMap, albedo_scale, compared_maps
from neilfpp_method.evaluate.views import RenderedView, evenly_spread, known_test_views, render_view
from neilfpp_method.report.data_urls import image_url
from neilfpp_method.train.run import Run

__all__ = [
    "MAX_SIZE",
    "MAX_VIEWS",
    "MIN_SIZE",
    "Cell",
    "ComparedViews",
    "Layer",
    "LightPicture",
    "ReportViews",
    "compare_views",
    "encode_views",
    "run_for_display",
    "title_of",
]

TITLES = {"rgb": "Image, rendering equation", "rgb_volume": "Image, volume rendering"}
"""Titles of maps whose own title is ambiguous, by name."""
MAX_VIEWS = 64
"""Largest number of views that a command shows; browsers open a larger page or image slowly."""
MIN_SIZE, MAX_SIZE = 16, 2048
"""Smallest and largest longest side of a shown view, pixels."""


@dataclass(frozen=True)
class Cell:
    """One map of one view as data URLs; truth and error are None if no truth is known."""

    estimate: str
    truth: str | None
    error: str | None


@dataclass(frozen=True)
class Layer:
    """One map of all views; `largest` is the error at the bright end of the colour scale, with its unit."""

    title: str
    note: str
    largest: str
    cells: tuple[Cell, ...]


@dataclass(frozen=True)
class LightPicture:
    """Incident light at a surface point as a latitude-longitude image, encoded as a data URL.

    Attributes:
        title: the point.
        column: "truth", "estimate" or "estimate, scaled".
        picture: the data URL.
    """

    title: str
    column: str
    picture: str


@dataclass(frozen=True)
class ReportViews:
    """The views of a report.

    Attributes:
        names: names of the views.
        photographs: the photographs as data URLs.
        width: width of a view, pixels.
        height: height of a view, pixels.
        layers: all maps.
        light: incident light at surface points.
        figures: metrics of these views by name.
    """

    names: tuple[str, ...]
    photographs: tuple[str, ...]
    width: int
    height: int
    layers: tuple[Layer, ...]
    light: tuple[LightPicture, ...]
    figures: dict[str, float]


@dataclass(frozen=True)
class ComparedViews:
    """The held-out views as rendered, compared with the truth.

    Attributes:
        rendered: the rendered views, in order.
        scale: factor per channel that fits the base colour to the truth; None if no truth is known.
        maps: all maps beside the truth, as 8-bit images.
        figures: metrics of these views by name, under the protocol neilfpp.
        mask_source: source of the masks (`evaluate.views.mask_source`).
    """

    rendered: tuple[RenderedView, ...]
    scale: Float[np.ndarray, " 3"] | None
    maps: tuple[ComparedMap, ...]
    figures: dict[str, float]
    mask_source: str


def run_for_display(run: Run, views: int, size: int) -> Run:
    """Return the run with a few small views held out, for display.

    Args:
        run: the run.
        views: number of views, chosen at even distances from its test views, or from its training views if
            none is held out.
        size: longest side of a view, pixels; views do not become larger than in training.
    """
    candidates = run.capture.test_views or run.capture.train_views
    names = evenly_spread([view.name for view in candidates], views)
    longest = max(max(file_size(view)) for view in run.capture.views)
    trained = max(max(view.camera.width, view.camera.height) for view in run.capture.views)
    capture = at_scale(run.capture, min(size, trained) / longest)
    return replace(run, capture=replace(capture, test=frozenset(names)))


def compare_views(run: Run, confidence: bool, on_progress: Callable[[float], None]) -> ComparedViews:
    """Render the held-out views and compare them with the truth.

    Args:
        run: a run from `run_for_display`.
        confidence: also compute the expected errors of the material.
        on_progress: called with the fraction of the work that is done.
    """
    held_out = run.capture.test_views
    rendered = []
    for i, view in enumerate(held_out):
        index = run.capture.views.index(view)
        rendered.append(render_view(run, index, lambda share, i=i: on_progress((i + share) / len(held_out))))
    held = known_test_views(run, rendered)
    known = held.views
    scale = albedo_scale(rendered, known) if run.has_material else None
    pairs = [(r, k) for r, k in zip(rendered, known, strict=True) if k.mask.any()]
    figures = image_metrics(run, pairs) | material_metrics(run, pairs) | normal_metrics(pairs)
    if confidence and run.has_material and run.capture.train_views:
        residuals = measure_residuals(run)
        rendered = [with_deviation(run, residuals, view, DISPLAY_STEP) for view in rendered]
    maps = tuple(compared_maps(run, rendered, known, scale))
    return ComparedViews(tuple(rendered), scale, maps, figures, held.mask_source)


def title_of(compared: ComparedMap) -> str:
    """A title of a map that is unique among the maps of a run."""
    title = f"{compared.title}, scaled" if compared.note.startswith("scaled") else compared.title
    return TITLES.get(compared.name, title)


def encode_views(run: Run, confidence: bool, on_progress: Callable[[float], None]) -> ReportViews:
    """Render the held-out views and encode them for a page. Arguments are those of `compare_views`."""
    compared = compare_views(run, confidence, on_progress)
    layers = tuple(
        Layer(
            title_of(m),
            m.note.replace("\n", ", "),
            f"{m.largest:g}{m.unit}",
            tuple(
                Cell(
                    image_url(c.estimate, c.hit),
                    None if c.truth is None else image_url(c.truth, c.known),
                    None if c.error is None else image_url(c.error, c.known),
                )
                for c in m.comparisons
            ),
        )
        for m in compared.maps
    )
    photographs = tuple(image_url(c.truth) for c in compared.maps[0].comparisons)
    camera = run.capture.test_views[0].camera
    light = _light(light_sections(run, compared.rendered, compared.scale)) if run.has_material else ()
    names = tuple(view.name for view in compared.rendered)
    return ReportViews(names, photographs, camera.width, camera.height, layers, light, compared.figures)


def _light(sections: Sequence[Section]) -> tuple[LightPicture, ...]:
    images = []
    for section in sections:
        columns = [(group.title, column) for group in section.groups for column in group.columns]
        pictures = section.rows[0].pictures
        images += [
            LightPicture(*c, image_url(p)) for c, p in zip(columns, pictures, strict=True) if p is not None
        ]
    return tuple(images)
