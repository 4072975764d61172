"""Views of a run for its page: every map, beside its truth or, where none is known, beside the photograph."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from neilfpp_method.data.scaling import at_scale, file_size
from neilfpp_method.evaluate.confidence import gather_evidence, with_deviation
from neilfpp_method.evaluate.panels import ComparedMap, albedo_scale, compared_maps, light_sections
from neilfpp_method.evaluate.protocols import image_metrics, material_metrics, normal_metrics
from neilfpp_method.evaluate.views import RenderedView, known_test_views, render_view
from neilfpp_method.report.encoded import encoded
from neilfpp_method.train.run import Run

__all__ = [
    "Cell",
    "Layer",
    "LightPicture",
    "Looked",
    "Shown",
    "evenly_spread",
    "look_at_views",
    "show_views",
    "shown_run",
    "title_of",
]

TITLES = {"rgb": "Image, rendering equation", "rgb_volume": "Image, volume rendering"}
CONFIDENCE_STEP = 2
"""One pixel in so many by so many is asked how far off it may be."""


@dataclass(frozen=True)
class Cell:
    """A map of a view as data addresses of pictures; truth and error are none where no truth is known."""

    estimate: str
    truth: str | None
    error: str | None


@dataclass(frozen=True)
class Layer:
    """A map over all views; `largest` is the error that its pictures show brightest, with its unit."""

    title: str
    note: str
    largest: str
    cells: tuple[Cell, ...]


@dataclass(frozen=True)
class LightPicture:
    """All directions of the light at a point, unrolled; `title` says where, `column` which."""

    title: str
    column: str
    picture: str


@dataclass(frozen=True)
class Shown:
    """Views by name with photographs and layers, the light at points, and figures of these views."""

    names: tuple[str, ...]
    photographs: tuple[str, ...]
    width: int
    height: int
    layers: tuple[Layer, ...]
    light: tuple[LightPicture, ...]
    figures: dict[str, float]


@dataclass(frozen=True)
class Looked:
    """The views that are held out as they were rendered, and all that is known of them.

    Attributes:
        rendered: the views, in order.
        scale: what fits the base colour to the truth, per channel; none where no truth is known.
        maps: every map beside its truth, ready to be shown.
        figures: of these views alone, as the protocol neilfpp measures them.
        mask_source: what decided which pixels count.
    """

    rendered: tuple[RenderedView, ...]
    scale: Float[np.ndarray, " 3"] | None
    maps: tuple[ComparedMap, ...]
    figures: dict[str, float]
    mask_source: str


def evenly_spread(names: Sequence[str], count: int) -> tuple[str, ...]:
    """So many of the names, spread over all of them.

    >>> evenly_spread("abcde", 3)
    ('a', 'c', 'e')
    """
    rows = np.linspace(0, len(names) - 1, min(count, len(names))).round().astype(int)
    return tuple(names[row] for row in rows)


def shown_run(run: Run, views: int, size: int) -> Run:
    """The run with so many views held out, spread over those that are, or over the training views where none
    is; no side of a view is longer than `size` pixels, or than it was in training.
    """
    chosen = run.capture.test_views or run.capture.train_views
    names = evenly_spread([view.name for view in chosen], views)
    longest = max(max(file_size(view)) for view in run.capture.views)
    trained = max(max(view.camera.width, view.camera.height) for view in run.capture.views)
    capture = at_scale(run.capture, min(size, trained) / longest)
    return replace(run, capture=replace(capture, test=frozenset(names)))


def look_at_views(run: Run, confidence: bool, on_progress: Callable[[float], None]) -> Looked:
    """Render the views that are held out, and set them beside all that is known of them.

    Args:
        run: as `shown_run` makes it.
        confidence: add how far off the material may be.
        on_progress: told the share that is done.
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
        evidence = gather_evidence(run)
        rendered = [with_deviation(run, evidence, view, CONFIDENCE_STEP) for view in rendered]
    maps = tuple(compared_maps(run, rendered, known, scale))
    return Looked(tuple(rendered), scale, maps, figures, held.mask_source)


def title_of(shown: ComparedMap) -> str:
    """The title of a map that tells it from every other map of a run."""
    aligned = f"{shown.title}, scaled" if shown.note.startswith("scaled") else shown.title
    return TITLES.get(shown.name, aligned)


def show_views(run: Run, confidence: bool, on_progress: Callable[[float], None]) -> Shown:
    """Render the views that are held out, and show all that is known of them; arguments as of
    `look_at_views`.
    """
    looked = look_at_views(run, confidence, on_progress)
    layers = tuple(
        Layer(
            title_of(m),
            m.note.replace("\n", ", "),
            f"{m.largest:g}{m.unit}",
            tuple(
                Cell(
                    encoded(c.estimate, c.hit),
                    None if c.truth is None else encoded(c.truth, c.known),
                    None if c.error is None else encoded(c.error, c.known),
                )
                for c in m.comparisons
            ),
        )
        for m in looked.maps
    )
    photographs = tuple(encoded(c.truth) for c in looked.maps[0].comparisons)
    camera = run.capture.test_views[0].camera
    light = _light(light_sections(run, looked.rendered, looked.scale)) if run.has_material else ()
    names = tuple(view.name for view in looked.rendered)
    return Shown(names, photographs, camera.width, camera.height, layers, light, looked.figures)


def _light(sections: Sequence) -> tuple[LightPicture, ...]:
    found = []
    for section in sections:
        columns = [(group.title, column) for group in section.groups for column in group.columns]
        pictures = section.rows[0].pictures
        found += [
            LightPicture(*c, encoded(p)) for c, p in zip(columns, pictures, strict=True) if p is not None
        ]
    return tuple(found)
