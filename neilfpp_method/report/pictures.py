"""Sections of a report with images: views with a slider, the surface in a 3D viewer, and the light."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from neilfpp_method.report.light import MapPicture
from neilfpp_method.report.markup import Html, cell, data_block, element, joined, table
from neilfpp_method.report.views import LightPicture, ReportViews

__all__ = ["light_section", "surface_section", "views_section"]

WITH_MATERIAL = {0: "Preview", 1: "Base colour", 2: "Roughness", 3: "Metallic", 4: "Normal"}
WITHOUT_MATERIAL = {5: "Shape", 4: "Normal"}
"""Titles of the layers of the surface by their numbers in `viewer.js`."""


def views_section(views: ReportViews, held_out: bool) -> Html:
    """Build the section with all maps and a slider; without scripts it shows the estimates only.

    Args:
        views: the rendered views.
        held_out: whether the views were held out of training.
    """
    names = list(views.names)
    strips = (
        element(
            "div",
            *(_thumbnail(layer.title, layer.cells[i].estimate, name) for layer in views.layers),
            class_="strip",
            data_view=i,
        )
        for i, name in enumerate(names)
    )
    note = (
        "These views were held out of training."
        if held_out
        else "No view is held out: training used the views shown here."
    )
    return joined(
        element("p", note, class_="pale"),
        _choices("view", "View", names),
        _choices("layer", "Map", [layer.title for layer in views.layers]),
        _radios("beside", "Compare with", [(name, name) for name in ("truth", "photograph", "error")]),
        element("figure", _stage(views), element("figcaption", id="views-caption", aria_live="polite")),
        *strips,
        element("noscript", element("p", "Without JavaScript this page shows only the estimates.")),
        data_block("views-data", _views_data(views)),
    )


def _stage(views: ReportViews) -> Html:
    """Photograph and first estimate of the first view with the slider between them."""
    first, name = views.layers[0], views.names[0]
    width = f"min(100%, calc(68vh * {views.width / views.height:.4f}))"
    return element(
        "div",
        element("img", class_="before", src=views.photographs[0], alt=f"Photograph, view {name}"),
        element(
            "img", class_="after", src=first.cells[0].estimate, alt=f"{first.title}, estimate, view {name}"
        ),
        element("span", "photograph", class_="tag left"),
        element("span", "estimate", class_="tag right"),
        element("input", type="range", min=0, max=100, value=50, aria_label="Border between the two images"),
        class_="stage",
        style=f"width: {width}; aspect-ratio: {views.width} / {views.height}",
    )


def _views_data(views: ReportViews) -> dict[str, Any]:
    """What the script of the page needs to exchange the images of the slider."""
    layers = [
        {
            "title": layer.title,
            "note": layer.note,
            "largest": layer.largest,
            "cells": [{"truth": compared.truth, "error": compared.error} for compared in layer.cells],
        }
        for layer in views.layers
    ]
    return {"names": list(views.names), "photographs": list(views.photographs), "layers": layers}


def surface_section(packed: Mapping[str, Any]) -> Html:
    """Build the section with the surface, from `packed_surface`, in a viewer."""
    layers = WITH_MATERIAL if "color" in packed else WITHOUT_MATERIAL
    return joined(
        _radios("surface-layer", "Layer", [(str(number), title) for number, title in layers.items()]),
        element(
            "canvas",
            id="surface-canvas",
            tabindex=0,
            role="img",
            aria_label="The surface of the run. Arrow keys rotate it; plus and minus change the distance.",
        ),
        element(
            "p",
            element("button", "Stop rotation", type="button", id="surface-pause"),
            " ",
            element("button", "Reset", type="button", id="surface-reset"),
        ),
        element(
            "p",
            "The viewer needs JavaScript.",
            id="surface-status",
            class_="pale",
            aria_live="polite",
        ),
        element(
            "p",
            "Only parts of the surface that a training camera sees are shown. The preview is lit from the "
            "camera, not by the light of the run.",
            class_="pale",
        ),
        data_block("surface-data", packed),
    )


def light_section(
    description: str,
    picture: MapPicture | None,
    lamps: Sequence[Mapping[str, Any]],
    points: Sequence[LightPicture],
) -> Html:
    """Build the section about the light.

    Args:
        description: a phrase that describes the light.
        picture: the environment map, or None.
        lamps: the lamps in the format of `lamps.json`.
        points: images of the incident light at surface points.
    """
    parts = [element("p", description[:1].upper() + description[1:] + ".")]
    if picture is not None:
        axes = "+z at the top, the azimuth from left to right"
        caption = f"The environment map: {axes}, exposure {picture.exposure:.2g}."
        alt = "The environment map in latitude-longitude projection"
        image = element("img", class_="map", src=picture.picture, alt=alt)
        parts.append(element("figure", image, element("figcaption", caption)))
    if lamps:
        head = ("lamp", "position (world frame)", "radius", "intensity (R, G, B)")
        parts.append(table(head, *map(_lamp, range(len(lamps)), lamps)))
    if points:
        figures = (
            element(
                "figure",
                element("img", src=p.picture, alt=f"{p.title}, {p.column}"),
                element("figcaption", f"{p.title}, {p.column}"),
            )
            for p in points
        )
        parts.append(element("div", *figures, class_="light"))
        parts.append(
            element(
                "p",
                "Positions are in the scene frame, in which the object has radius 1. Directions below the "
                "surface are grey; rings mark the directions to lamps.",
                class_="pale",
            )
        )
    return joined(*parts)


def _lamp(number: int, lamp: Mapping[str, Any]) -> Html:
    peak = max(*lamp["intensity"], 1e-9)
    color = ", ".join(str(round(255 * max(value / peak, 0) ** (1 / 2.2))) for value in lamp["intensity"])
    swatch = element("span", class_="swatch", style=f"background: rgb({color})")
    values = (
        ", ".join(f"{value:.3g}" for value in lamp["position"]),
        f"{lamp['radius']:.3g}",
        ", ".join(f"{value:.3g}" for value in lamp["intensity"]),
    )
    return element("tr", element("th", swatch, f" {number + 1}", scope="row"), *map(cell, values))


def _thumbnail(title: str, url: str, view: str) -> Html:
    return element(
        "figure",
        element("img", src=url, alt=f"{title}, estimate, view {view}"),
        element("figcaption", title),
    )


def _choices(name: str, title: str, texts: Sequence[str]) -> Html:
    """Radio buttons whose values are the numbers of the texts."""
    return _radios(name, title, [(str(i), text) for i, text in enumerate(texts)])


def _radios(name: str, title: str, choices: Sequence[tuple[str, str]]) -> Html:
    """Radio buttons for pairs of value and text; the first one is chosen."""
    labels = (
        element(
            "label",
            element("input", type="radio", name=name, value=value, checked=i == 0),
            text,
            class_="choice",
        )
        for i, (value, text) in enumerate(choices)
    )
    return element("fieldset", element("legend", title), *labels)
