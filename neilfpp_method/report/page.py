"""The page of a run as HTML: a section for each thing there is to see, in one file that loads nothing."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Mapping, Sequence
from importlib import resources
from typing import Any

from neilfpp_method.evaluate.glossary import explain
from neilfpp_method.health.cases import Finding, verdict_of
from neilfpp_method.report.files import Changed
from neilfpp_method.report.markup import Html, data_block, element, joined, table
from neilfpp_method.report.views import LightPicture, Shown

__all__ = [
    "effects_section",
    "facts_section",
    "figures_section",
    "health_section",
    "light_section",
    "page",
    "reading_section",
    "settings_section",
    "surface_section",
    "time_section",
    "views_section",
]

STAGE_TITLES = {
    "preparation": "Preparation",
    "sdf_init": "SDF init",
    "material_init": "Material init",
    "joint": "Joint",
}

READING = {
    "Truth, estimate, error.": (
        "Dark errors are small. Where the capture has no truth of a map, the photograph stands beside it."
    ),
    "Base colour and light share a factor.": (
        "Twice the light on half the base colour gives the same images, in each channel. Unless the scene holds "
        "something of known colour, that factor is free. So base colour is shown as estimated and, where the truth is known, "
        "with the best factor per channel, and the light with the inverse of it. Neither alone tells enough."
    ),
    "Roughness and metallic need highlights.": "Where a surface shows none, the priors decide: rough, and no metal.",
    "Light is known where it matters.": (
        "It is estimated above surfaces that the images show. Where the surface is rough, only its broad shape "
        "leaves a trace in the images."
    ),
    "Figures.": (
        "They are means over the test views, of the pixels that show the object. PSNR grows by 6 dB when the error "
        "halves. The whole frame counts the background as free of error, as some published tables do, and is higher "
        "by its share. What needs no method is a constant for roughness and metallic, and the mean image for base "
        "colour."
    ),
    "Display values clip.": "8-bit captures lose what is brighter than white; light and metallic then come out low.",
}


def page(title: str, subtitle: str, sections: Sequence[tuple[str, str, Html]]) -> str:
    """The whole page.

    Args:
        title: of the run.
        subtitle: a line below it.
        sections: identifier, heading and content of each.
    """
    static = resources.files("neilfpp_method.report") / "static"
    style = (static / "page.css").read_text("utf-8")
    scripts = [(static / name).read_text("utf-8") for name in ("compare.js", "viewer.js")]
    # No address is loaded, and no script runs but those two, whatever a name in a file may hold.
    hashes = " ".join(f"'sha256-{_sha256(script)}'" for script in scripts)
    policy = f"default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src {hashes}"
    head = element(
        "head",
        element("meta", charset="utf-8"),
        element("meta", http_equiv="Content-Security-Policy", content=policy),
        element("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("title", title),
        element("style", Html(style)),
    )
    links = (element("a", heading, href=f"#{name}") for name, heading, _ in sections)
    body = element(
        "body",
        element("header", element("h1", title), element("p", subtitle, class_="pale")),
        element("nav", *links, aria_label="Sections"),
        element(
            "main", *(element("section", element("h2", h), content, id=name) for name, h, content in sections)
        ),
        *(element("script", Html(script)) for script in scripts),
    )
    return f"<!doctype html>\n{element('html', head, body, lang='en')}\n"


def _sha256(text: str) -> str:
    return base64.b64encode(hashlib.sha256(text.encode("utf-8")).digest()).decode("ascii")


# ---------------------------------------------------------------------------------------------------------------- parts


def health_section(findings: Sequence[Finding] | None, notes: Sequence[str]) -> Html:
    """The verdict with what was found, its cause and its remedy, and what else is to be known first."""
    said = [element("p", note, class_="note") for note in notes]
    if findings is None:
        return joined(*said, element("p", "This run has no record of its health."))
    verdict = verdict_of(findings)
    said.insert(0, element("p", element("b", verdict.capitalize(), class_=verdict)))
    if not findings:
        said.insert(1, element("p", "None of the cases in docs/health.md was found."))
        return joined(*said)
    rows = (
        element("tr", element("th", f.what, scope="row"), *map(_cell, (f.cause, f.remedy, f"step {f.step}")))
        for f in findings
    )
    return joined(*said, table(("what was found", "likely cause", "remedy", "when"), *rows))


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
        _choices(
            "layer",
            "Map",
            [
                layer.title if "scaled" not in layer.note else f"{layer.title}, scaled"
                for layer in shown.layers
            ],
        ),
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
            aria_label="The surface of the run, turning. Arrow keys turn it, plus and minus change the distance.",
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
            "Only what a training camera saw is shown. The preview is lit from the camera, not by the light of the run.",
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
    return element("tr", element("th", swatch, f" {number + 1}", scope="row"), *map(_cell, values))


def figures_section(metrics: Mapping[str, float], said: str) -> Html:
    """A row per figure; `x_frame` and `baseline_x` stand in the row of `x`."""
    if not metrics:
        return element("p", said)
    beside = {name: (f"{name}_frame", f"baseline_{name}") for name in metrics}
    companions = {companion for pair in beside.values() for companion in pair}
    rows = []
    for name in metrics:
        if name in companions:
            continue
        entry = explain(name)
        value, frame, baseline = (
            entry.format(metrics[key]) if key in metrics else "–" for key in (name, *beside[name])
        )
        arrow = {"higher": "↑", "lower": "↓"}[entry.better]
        rows.append(
            element(
                "tr",
                element("th", entry.title, element("br"), element("code", name), scope="row"),
                element(
                    "td",
                    element("b", value),
                    " ",
                    element("span", arrow, title=f"{entry.better} is better"),
                    class_="number",
                ),
                element("td", frame, class_="number"),
                element("td", baseline, class_="number"),
                element("td", entry.meaning),
            )
        )
    names = ("figure", "this run", "whole frame", "without a method", "what it says")
    return joined(element("p", said, class_="pale"), table(names, *rows))


def time_section(
    timing: Mapping[str, float], work: Mapping[str, Mapping[str, float]], previews: Sequence[tuple[str, str]]
) -> Html:
    """Seconds of each stage, what they went to, and a picture at the end of each."""
    stages = {stage: sum(parts.values()) for stage, parts in work.items()} or dict(timing)
    if not stages:
        return element("p", "No stage has been timed.")
    total = sum(stages.values())
    rows = [
        element(
            "tr",
            element("th", STAGE_TITLES.get(stage, stage), scope="row"),
            element("td", _duration(seconds), class_="number"),
            element(
                "td", element("i", style=f"width: {100 * seconds / max(total, 1e-9):.1f}%"), class_="bar"
            ),
            element("td", _most(work.get(stage, {})), class_="pale"),
        )
        for stage, seconds in stages.items()
    ]
    rows.append(
        element(
            "tr",
            element("th", "Together", scope="row"),
            element("td", element("b", _duration(total)), class_="number"),
            *(2 * [element("td")]),
        )
    )
    pictures = (
        element(
            "figure",
            element("img", class_="map", src=address, alt=f"Preview at the end of {stage}"),
            element(
                "figcaption",
                f"End of {STAGE_TITLES.get(stage, stage)}: photograph, R, normal, then PBR, base colour, roughness, metallic",
            ),
        )
        for stage, address in previews
    )
    return joined(table(("stage", "time", "", "most of it"), *rows), *pictures)


def _most(parts: Mapping[str, float]) -> str:
    total = sum(parts.values())
    largest = sorted(parts.items(), key=lambda part: -part[1])[:3]
    return ", ".join(
        f"{name.replace('_', ' ')} {100 * seconds / total:.0f} %" for name, seconds in largest if total > 0
    )


def effects_section(rows: Sequence[Mapping[str, Any]]) -> Html:
    """The plan of effects; nothing where the run has none."""
    if not rows:
        return element("p", "This run has no plan of effects: its settings decide.")
    names = ("title", "decision", "reason", "cost", "risk")
    lines = (
        element(
            "tr",
            element("th", str(row.get("title", row.get("effect", ""))), scope="row"),
            *(_cell(str(row.get(n, ""))) for n in names[1:]),
        )
        for row in rows
    )
    return table(("effect", "decision", "why", "cost when on", "left out by mistake"), *lines)


def settings_section(preset: str, changed: Sequence[Changed] | None) -> Html:
    """The settings that are not those of the preset."""
    if changed is None:
        return element(
            "p", f"The preset {preset} is not known to this version; config.json has every setting."
        )
    if not changed:
        return element("p", f"Every setting is that of the preset {preset}.")
    rows = (
        element(
            "tr",
            element("th", element("code", c.name), scope="row"),
            _cell(c.value),
            _cell("–" if c.usual is None else c.usual),
        )
        for c in changed
    )
    return table(("setting", "this run", f"preset {preset}"), *rows)


def reading_section() -> Html:
    """How to read what is shown."""
    return element("ul", *(element("li", element("b", head), f" {text}") for head, text in READING.items()))


def facts_section(facts: Mapping[str, str]) -> Html:
    """What made the run."""
    rows = (
        element("tr", element("th", name, scope="row"), element("td", text, class_="long"))
        for name, text in facts.items()
    )
    return table((), *rows)


def _cell(text: str) -> Html:
    return element("td", text, class_="long")


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


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes:02d} min"
    return f"{minutes} min {rest:02d} s" if minutes else f"{seconds:.1f} s"
