"""The parts of a page that say what there is in words and figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from neilfpp_method.evaluate.glossary import explain
from neilfpp_method.health.cases import Finding, verdict_of
from neilfpp_method.report.curves import quality_curve, work_bars
from neilfpp_method.report.files import Changed
from neilfpp_method.report.markup import Html, cell, element, joined, table, with_code
from neilfpp_method.train.quality import Look

__all__ = [
    "STAGE_TITLES",
    "effects_section",
    "facts_section",
    "figures_section",
    "health_section",
    "reading_section",
    "settings_section",
    "time_section",
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
        "Twice the light on half the base colour gives the same images, in each channel. Unless the scene "
        "holds something of known colour, that factor is free. So base colour is shown as estimated and, "
        "where the truth is known, with the best factor per channel, and the light with the inverse of it. "
        "Neither alone tells enough."
    ),
    "Roughness and metallic need highlights.": (
        "Where a surface shows none, the priors decide: rough, and no metal."
    ),
    "Light is known where it matters.": (
        "It is estimated above surfaces that the images show. Where the surface is rough, only its broad "
        "shape leaves a trace in the images."
    ),
    "Figures.": (
        "They are means over the test views, of the pixels that show the object. PSNR grows by 6 dB when "
        "the error halves. The whole frame counts the background as free of error, as some published tables "
        "do, and is higher by its share. What needs no method is a constant for roughness and metallic, and "
        "the mean image for base colour."
    ),
    "Display values clip.": (
        "8-bit captures lose what is brighter than white; light and metallic then come out low."
    ),
}


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
        element("tr", element("th", f.what, scope="row"), *map(cell, (f.cause, f.remedy, f"step {f.step}")))
        for f in findings
    )
    return joined(*said, table(("what was found", "likely cause", "remedy", "when"), *rows))


def figures_section(metrics: Mapping[str, float], said: str) -> Html:
    """A row per figure; `x_frame` and `baseline_x` stand in the row of `x`."""
    if not metrics:
        return element("p", said)
    beside = {name: (f"{name}_frame", f"baseline_{name}") for name in metrics}
    companions = {companion for pair in beside.values() for companion in pair}
    titles = ("whole frame", "without a method")
    filled = [k for k in range(len(titles)) if any(pair[k] in metrics for pair in beside.values())]
    rows = []
    for name in metrics:
        if name in companions:
            continue
        entry = explain(name)
        keys = (name, *(beside[name][k] for k in filled))
        value, *others = (entry.format(metrics[key]) if key in metrics else "–" for key in keys)
        arrow = {"higher": "↑", "lower": "↓"}.get(entry.better)
        beside_value = (" ", element("span", arrow, title=f"{entry.better} is better")) if arrow else ()
        rows.append(
            element(
                "tr",
                element("th", entry.title, element("br"), element("code", name), scope="row"),
                element(
                    "td",
                    element("b", value),
                    *beside_value,
                    class_="number",
                ),
                *(element("td", other, class_="number") for other in others),
                element("td", entry.meaning),
            )
        )
    names = ("figure", "this run", *(titles[k] for k in filled), "what it says")
    return joined(element("p", with_code(said), class_="pale"), table(names, *rows))


def time_section(
    timing: Mapping[str, float],
    work: Mapping[str, Mapping[str, float]],
    looks: Sequence[Look],
    previews: Sequence[tuple[str, str]],
) -> Html:
    """Seconds of each stage, what they went to, what they bought, and a picture at the end of each."""
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
                f"End of {STAGE_TITLES.get(stage, stage)}: photograph, R, normal, then PBR, base colour, "
                "roughness, metallic",
            ),
        )
        for stage, address in previews
    )
    times = table(("stage", "time", "", "most of it"), *rows)
    curve = quality_curve(looks)
    said = (
        "Quality on the way, at small patches of training views that no step learns from:" if curve else None
    )
    return joined(
        times, work_bars(work, STAGE_TITLES), said and element("p", said, class_="pale"), curve, *pictures
    )


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
            *(cell(str(row.get(n, ""))) for n in names[1:]),
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
            cell(c.value),
            cell("–" if c.usual is None else c.usual),
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


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes:02d} min"
    return f"{minutes} min {rest:02d} s" if minutes else f"{seconds:.1f} s"
