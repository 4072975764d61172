"""Sections of a report with text and tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from neilfpp_method.evaluate.glossary import style_of
from neilfpp_method.health.cases import Finding, verdict_of
from neilfpp_method.report.curves import quality_curve, work_bars
from neilfpp_method.report.files import ChangedSetting
from neilfpp_method.report.markup import Html, cell, element, joined, table, with_code
from neilfpp_method.schedule import Stage
from neilfpp_method.train.quality import QualityCheck

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

EXPLANATIONS = {
    "Truth, estimate, error.": (
        "In images of the error, dark means small. If the capture has no truth for a map, the photograph is "
        "shown instead."
    ),
    "Base colour and light share a factor.": (
        "In each channel, twice the light on half the base colour gives the same images, so images cannot "
        "determine this factor unless the scene contains an object of known colour. Base colour is therefore "
        "shown as estimated and, if the truth is known, also after the best factor per channel; the light is "
        "also shown after the inverse of that factor. Consider both versions."
    ),
    "Roughness and metallic need highlights.": (
        "On a surface without visible highlights the priors decide, which prefer rough non-metals."
    ),
    "The light is estimated only where it has an effect.": (
        "Light can be estimated above surfaces that the images show. Above rough surfaces, the images "
        "determine only its low frequencies."
    ),
    "Figures.": (
        "Figures are averaged over the pixels of the object in each test view, and then over the test views. "
        "PSNR increases by 6 dB when the error halves. A figure over the whole frame counts the background "
        "as free of error, as some published tables do, and is therefore higher. The naive baseline is a "
        "constant for roughness and metallic, and the mean observed colour for base colour."
    ),
    "Display values clip.": (
        "8-bit images contain no values brighter than white, so light and metallic are underestimated."
    ),
}
"""Heading and text of each paragraph of `reading_section`."""


def health_section(findings: Sequence[Finding] | None, notes: Sequence[str]) -> Html:
    """Build the section with the verdict, notes, and the findings with causes and remedies.

    Args:
        findings: findings of the health checks; None if the run has no record of them.
        notes: remarks that the reader should see first.
    """
    paragraphs = [element("p", note, class_="note") for note in notes]
    if findings is None:
        return joined(*paragraphs, element("p", "This run has no record of its health."))
    verdict = verdict_of(findings)
    paragraphs.insert(0, element("p", element("b", verdict.capitalize(), class_=verdict)))
    if not findings:
        paragraphs.insert(1, element("p", "None of the problems in docs/health.md was found."))
        return joined(*paragraphs)
    rows = (
        element("tr", element("th", f.what, scope="row"), *map(cell, (f.cause, f.remedy, f"step {f.step}")))
        for f in findings
    )
    return joined(*paragraphs, table(("finding", "likely cause", "remedy", "when"), *rows))


def figures_section(metrics: Mapping[str, float], description: str) -> Html:
    """Build a table with a row per figure; `x_frame` and `baseline_x` are columns in the row of `x`.

    Args:
        metrics: figures by name; at least one.
        description: how they were measured.
    """
    companions = {name: (f"{name}_frame", f"baseline_{name}") for name in metrics}
    titles = ("whole frame", "naive baseline")
    filled = [k for k in range(len(titles)) if any(pair[k] in metrics for pair in companions.values())]
    in_other_rows = {companion for pair in companions.values() for companion in pair}
    rows = []
    for name in metrics:
        if name in in_other_rows:
            continue
        style = style_of(name)
        keys = (name, *(companions[name][k] for k in filled))
        value, *others = (style.format(metrics[key]) if key in metrics else "–" for key in keys)
        symbol = {"higher": "↑", "lower": "↓"}.get(style.better)
        arrow = (" ", element("span", symbol, title=f"{style.better} is better")) if symbol else ()
        rows.append(
            element(
                "tr",
                element("th", style.title, element("br"), element("code", name), scope="row"),
                element("td", element("b", value), *arrow, class_="number"),
                *(element("td", other, class_="number") for other in others),
                element("td", style.meaning),
            )
        )
    names = ("figure", "this run", *(titles[k] for k in filled), "meaning")
    return joined(element("p", with_code(description), class_="pale"), table(names, *rows))


def time_section(
    stages: Mapping[str, float],
    work: Mapping[str, Mapping[str, float]],
    checks: Sequence[QualityCheck],
    previews: Mapping[str, str],
) -> Html:
    """Build the section with the time of each stage by kind of work, quality over time, and previews.

    Args:
        stages: seconds by stage.
        work: seconds by stage and kind of work; empty if they are not known.
        checks: measurements at held-back pixels during training.
        previews: data URL of the image at the end of each stage, by stage.
    """
    if not stages:
        return element("p", "No stage has been timed.")
    pictures = (
        element(
            "figure",
            element("img", class_="map", src=url, alt=f"Preview at the end of {stage}"),
            element("figcaption", f"End of {STAGE_TITLES.get(stage, stage)}: {_panels_of(stage)}"),
        )
        for stage, url in previews.items()
    )
    curve = quality_curve(checks)
    caption = "Quality during training at held-back pixels, small patches of training views:"
    caption = element("p", caption, class_="pale") if curve else None
    return joined(_time_table(stages, work), work_bars(work, STAGE_TITLES), caption, curve, *pictures)


def _time_table(stages: Mapping[str, float], work: Mapping[str, Mapping[str, float]]) -> Html:
    """A row for each stage with its largest kinds of work, and one for the total."""
    total = sum(stages.values())
    rows = [
        element(
            "tr",
            element("th", STAGE_TITLES.get(stage, stage), scope="row"),
            element("td", _duration(seconds), class_="number"),
            element("td", _bar(seconds / max(total, 1e-9)), class_="bar"),
            element("td", _largest_parts(work.get(stage, {})), class_="pale"),
        )
        for stage, seconds in stages.items()
    ]
    rows.append(
        element(
            "tr",
            element("th", "Total", scope="row"),
            element("td", element("b", _duration(total)), class_="number"),
            *(2 * [element("td")]),
        )
    )
    return table(("stage", "time", "", "largest parts"), *rows)


def _panels_of(stage: str) -> str:
    """The panels of the preview of a stage, from left to right (`train.preview`)."""
    geometry = "photograph, R, normal"
    return geometry if stage == Stage.SDF_INIT.value else f"{geometry}, PBR, base colour, roughness, metallic"


def _bar(share: float) -> Html:
    return element("i", style=f"width: {100 * share:.1f}%")


def _largest_parts(parts: Mapping[str, float]) -> str:
    total = sum(parts.values())
    largest = sorted(parts.items(), key=lambda part: -part[1])[:3]
    return ", ".join(
        f"{name.replace('_', ' ')} {100 * seconds / total:.0f} %" for name, seconds in largest if total > 0
    )


def effects_section(rows: Sequence[Mapping[str, Any]]) -> Html:
    """Build the table of effects from the rows of `effects.json`."""
    if not rows:
        return element("p", "This run has no plan of effects; its settings determine what is simulated.")
    names = ("title", "decision", "reason", "cost", "risk")
    lines = (
        element(
            "tr",
            element("th", str(row.get("title", row.get("effect", ""))), scope="row"),
            *(cell(str(row.get(n, ""))) for n in names[1:]),
        )
        for row in rows
    )
    return table(("effect", "decision", "reason", "cost if on", "risk if left out"), *lines)


def settings_section(preset: str, changed: Sequence[ChangedSetting] | None) -> Html:
    """Build the table of settings that differ from the preset; None if the preset is not known."""
    if changed is None:
        return element(
            "p", f"This version does not know the preset {preset}; config.json contains all settings."
        )
    if not changed:
        return element("p", f"All settings are those of the preset {preset}.")
    rows = (
        element(
            "tr",
            element("th", element("code", c.name), scope="row"),
            cell(c.value),
            cell("–" if c.preset_value is None else c.preset_value),
        )
        for c in changed
    )
    return table(("setting", "this run", f"preset {preset}"), *rows)


def reading_section() -> Html:
    """Build the section that explains how to interpret the report."""
    return element(
        "ul", *(element("li", element("b", head), f" {text}") for head, text in EXPLANATIONS.items())
    )


def facts_section(facts: Mapping[str, str]) -> Html:
    """Build a table of facts by name."""
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
