"""The effects that can be simulated or left out, as data. Each is a change of settings."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from neilfpp_method.settings.plain import changed
from neilfpp_method.settings.types import FreeLightConfig, MapLightConfig, NeilfConfig

__all__ = ["EFFECTS", "Effect", "switched"]


@dataclass(frozen=True)
class Effect:
    """Something that light does, or that a scene has, and what it takes to simulate it.

    Attributes:
        name: on the command line and in `effects.json`.
        title: for people.
        is_on: whether settings simulate it, or leave it open.
        on: the settings that switch it on.
        off: the settings that switch it off.
        obstacle: why it cannot be switched with these settings; empty: it can.
        cost: what it takes while a material is learned.
        risk: what goes wrong where it is left out of a scene that has it.
        unjudged: why no evidence decides with these settings; empty: evidence does.
        solved: the light solver decides it again at each fit, so evidence changes no setting.
    """

    name: str
    title: str
    is_on: Callable[[NeilfConfig], bool]
    on: Callable[[NeilfConfig], Mapping[str, Any]]
    off: Mapping[str, Any]
    obstacle: Callable[[NeilfConfig], str]
    cost: Callable[[NeilfConfig], str]
    risk: str
    unjudged: Callable[[NeilfConfig], str] = lambda config: ""
    solved: bool = False


def switched(config: NeilfConfig, effect: Effect, on: bool) -> NeilfConfig:
    """The same settings with one effect on or off."""
    return changed(config, effect.on(config) if on else effect.off)


def _none(config: NeilfConfig) -> str:
    return ""


def _traced_on(config: NeilfConfig) -> Mapping[str, Any]:
    settings = config.inter_reflection
    usual = "soft" if isinstance(config.light, FreeLightConfig) else "hard"
    return {"inter_reflection.mode": usual if settings.mode == "off" else settings.mode}


def _traced_cost(config: NeilfConfig) -> str:
    points, settings = config.train.rays, config.inter_reflection
    if isinstance(config.light, FreeLightConfig):
        return f"{settings.rays_per_point * points:.0f} rendered rays a step"
    return f"{config.shading.train_samples * points} traced rays a step"


def _free_light(what: str) -> Callable[[NeilfConfig], str]:
    return lambda config: what if isinstance(config.light, FreeLightConfig) else ""


EFFECTS: Mapping[str, Effect] = {
    effect.name: effect
    for effect in (
        Effect(
            name="inter-reflection",
            title="shadows, and light from surface to surface",
            is_on=lambda config: config.inter_reflection.mode != "off",
            on=_traced_on,
            off={"inter_reflection.mode": "off"},
            obstacle=_none,
            cost=_traced_cost,
            risk="shadows and light between surfaces become base colour",
        ),
        Effect(
            name="lamps",
            title="lamps close by",
            is_on=lambda config: isinstance(config.light, MapLightConfig) and config.light.kind != "distant",
            on=lambda config: {"light.kind": "distant_near"},
            off={"light.kind": "distant"},
            obstacle=_free_light("a light that is free at every point holds that of lamps"),
            cost=lambda config: (
                f"a second fit of the light every {_every(config)} steps, and a shadow ray per point and lamp"
            ),
            risk="the glow of a lamp becomes base colour",
            solved=True,
        ),
        Effect(
            name="metals",
            title="metals",
            is_on=lambda config: config.brdf.metals,
            on=lambda config: {"brdf.metals": True},
            off={"brdf.metals": False},
            obstacle=lambda config: (
                "" if config.shading.specular else "a surface without reflection shows no metal"
            ),
            cost=lambda config: "one more unknown at every point",
            risk="metal becomes dark gloss",
            unjudged=_free_light(
                "not judged: a light that is free at every point explains paint and metal alike"
            ),
        ),
        Effect(
            name="long-tails",
            title="the long tails of highlights (GGX)",
            is_on=lambda config: config.shading.lobe == "ggx",
            on=lambda config: {"shading.lobe": "ggx"},
            off={"shading.lobe": "spherical_gaussian"},
            obstacle=lambda config: (
                "" if config.shading.specular else "a surface without reflection has no highlights"
            ),
            cost=lambda config: "none",
            risk="the glow about highlights becomes roughness",
            unjudged=_free_light("not judged: a light that is free at every point explains both lobes alike"),
        ),
        Effect(
            name="background",
            title="an open background",
            is_on=lambda config: config.background.kind != "constant",
            on=lambda config: {"background.kind": "inverted_sphere"},
            off={"background.kind": "constant"},
            obstacle=lambda config: "R paints the scene sphere" if config.background.kind == "none" else "",
            cost=lambda config: f"{config.background.samples} network queries per ray",
            risk="what lies behind the scene becomes surfaces in it",
        ),
    )
}
"""By name, in the order of the table."""


def _every(config: NeilfConfig) -> int:
    return config.light.fit.every if isinstance(config.light, MapLightConfig) else 0
