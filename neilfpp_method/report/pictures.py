"""The parts of a page that show pictures: views with a slider, the surface to turn, the light."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from neilfpp_method.report.markup import Html, cell, data_block, element, joined, table
from neilfpp_method.report.views import LightPicture, Shown

__all__ = ["light_section", "surface_section", "views_section"]


def views_section(shown: Shown, held_out: bool) -> Html:
    """Every map with a slider; without scripts, all estimates."""
    names = list(shown.names)
    block = {
        "names": names,
        "photographs": list(shown.photographs),
        "layers": [
            {
                "title": layer.title,
                "note": layer.note,
                "largest": layer.largest,
                "cells": [{"truth": cell.truth, "error": cell.error} for cell in layer.cells],
            }
            for layer in shown.layers
        ],
    }
    first = shown.layers[0]
    width = f"min(100%, calc(68vh * {shown.width / shown.height:.4f}))"
    stage = element(
        "div",
        element("img", class_="before", src=shown.photographs[0], alt=f"Photograph, view {names[0]}"),
        element(
            "img",
            class_="after",
            src=first.cells[0].estimate,
            alt=f"{first.title}, estimate, view {names[0]}",
        ),
        element("span", "photograph", class_="tag left"),
        element("span", "estimate", class_="tag right"),
        element(
            "input", type="range", min=0, max=100, value=50, aria_label="Border between the two pictures"
        ),
        class_="stage",
        style=f"width: {width}; aspect-ratio: {shown.width} / {shown.height}",
    )
    strips = (
        element(
            "div",
            *(_thumbnail(layer.title, layer.cells[i].estimate, name) for layer in shown.layers),
            class_="strip",
            data_view=i,
        )
        for i, name in enumerate(names)
    )
    note = (
        "Views that were not trained on."
        if held_out
        else "No view is held out: these are views that were trained on."
    )
    return joined(
        element("p", note, class_="pale"),
        _choices("view", "View", names),
        _choices("layer", "Map", [layer.title for layer in shown.layers]),
        _choices("beside", "Beside", ["truth", "photograph", "error"], values=True),
        element("figure", stage, element("figcaption", id="views-caption", aria_live="polite")),
        *strips,
        element("noscript", element("p", "Without scripts this page shows the estimates alone.")),
        data_block("views-data", block),
    )


def surface_section(packed: Mapping[str, Any] | None, reason: str) -> Html:
    """The surface in a viewer; none: why there is none."""
    if packed is None:
        return element("p", f"There is no surface to show: {reason}.")
    layers = ["Preview", "Base colour", "Roughness", "Metallic", "Normal"]
    chosen = (
        [(str(i), name) for i, name in enumerate(layers)]
        if "color" in packed
        else [("5", "Shape"), ("4", "Normal")]
    )
    return joined(
        _radios("surface-layer", "Layer", chosen),
        element(
            "canvas",
            id="surface-canvas",
            tabindex=0,
            role="img",
            aria_label="The surface of the run. Arrow keys turn it, plus and minus change the distance.",
        ),
        element(
            "p",
            element("button", "Stop turning", type="button", id="surface-pause"),
            " ",
            element("button", "Reset", type="button", id="surface-reset"),
        ),
        element(
            "p",
            "Without scripts there is nothing to turn.",
            id="surface-said",
            class_="pale",
            aria_live="polite",
        ),
        element(
            "p",
            "Only what a training camera saw is shown. The preview is lit from the camera, not by the light "
            "of the run.",
            class_="pale",
        ),
        data_block("surface-data", packed),
    )


def light_section(
    words: str,
    picture: tuple[str, float] | None,
    lamps: Sequence[Mapping[str, Any]],
    points: Sequence[LightPicture],
) -> Html:
    """The light in words, the map, the lamps, and what arrives at points."""
    parts = [element("p", words[:1].upper() + words[1:] + ".")]
    if picture is not None:
        caption = (
            f"The environment map: +z at the top, the azimuth from left to right, exposure {picture[1]:.2g}."
        )
        image = element(
            "img", class_="map", src=picture[0], alt="The environment map, all directions unrolled"
        )
        parts.append(element("figure", image, element("figcaption", caption)))
    if lamps:
        parts.append(
            table(
                ("lamp", "place in the world", "radius", "intensity (R, G, B)"),
                *map(_lamp, range(len(lamps)), lamps),
            )
        )
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
                "Places are in the scene frame, where the object has radius 1. Grey is below the surface; "
                "rings are about lamps.",
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


def _thumbnail(title: str, address: str, view: str) -> Html:
    return element(
        "figure",
        element("img", src=address, alt=f"{title}, estimate, view {view}"),
        element("figcaption", title),
    )


def _choices(name: str, title: str, texts: Sequence[str], values: bool = False) -> Html:
    return _radios(name, title, [(text if values else str(i), text) for i, text in enumerate(texts)])


def _radios(name: str, title: str, choices: Sequence[tuple[str, str]]) -> Html:
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
