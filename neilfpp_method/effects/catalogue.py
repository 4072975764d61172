"""The effects that can be simulated or left out, as data. Each is a change of settings."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from neilfpp_method.settings.plain import changed
from neilfpp_method.settings.presets import EXPOSURE_RATE
from neilfpp_method.settings.types import FreeLightConfig, MapLightConfig, MeshConfig, NeilfConfig

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
        advised: evidence is shown and changes nothing: it cannot tell that the effect is not needed.
        needs: an effect without which there is none of this; empty: nothing.
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
    advised: bool = False
    needs: str = ""


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


def _is_map(config: NeilfConfig) -> bool:
    return isinstance(config.light, MapLightConfig)


def _without_reflection(what: str) -> Callable[[NeilfConfig], str]:
    return lambda config: "" if config.shading.specular else what


def _map_on(config: NeilfConfig) -> Mapping[str, Any]:
    height = config.light.environment_height
    return {"light.environment_height": height if height > 1 else MapLightConfig().environment_height}


def _given_map(config: NeilfConfig) -> str:
    return "the map is given" if config.known_map is not None else ""


def _joint_obstacle(config: NeilfConfig) -> str:
    if isinstance(config.host, MeshConfig):
        return "the surface is given, and the material moves with R from the start"
    return "" if config.train.joint_steps else "no steps are set for it (train.joint_steps)"


UNKNOWN_IN_FREE_LIGHT = "not judged: a light that is free at every point explains any material"

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
            name="environment-map",
            title="an environment map, not one colour from everywhere",
            is_on=lambda config: _is_map(config) and config.light.environment_height > 1,
            on=_map_on,
            off={"light.environment_height": 1},
            obstacle=lambda config: (
                _free_light("a light that is free at every point is no map")(config) or _given_map(config)
            ),
            cost=lambda config: (
                f"{config.shading.train_samples * config.train.rays} look-ups a step, half of the directions "
                f"drawn by the light, and fits of {2 * config.light.environment_height**2} texels"
                if _is_map(config)
                else ""
            ),
            risk="shading and reflections of the light become base colour",
            advised=True,
        ),
        Effect(
            name="coloured-light",
            title="colours in the map, not white light",
            is_on=lambda config: not config.light.monochrome,
            on=lambda config: {"light.monochrome": False},
            off={"light.monochrome": True},
            obstacle=_given_map,
            cost=lambda config: "three unknowns a texel, not one",
            risk="colours of the light become base colour",
            advised=True,
            unjudged=_free_light(UNKNOWN_IN_FREE_LIGHT),
        ),
        Effect(
            name="reflection",
            title="specular reflection",
            is_on=lambda config: config.shading.specular,
            on=lambda config: {"shading.specular": True},
            off={"shading.specular": False},
            obstacle=_none,
            cost=lambda config: (
                f"a lobe in {config.shading.train_samples * config.train.rays} directions a step, and three "
                "matrices in fits of the light, not one"
            ),
            risk="gloss becomes base colour",
            advised=True,
            unjudged=_free_light(UNKNOWN_IN_FREE_LIGHT),
        ),
        Effect(
            name="metals",
            title="metals",
            is_on=lambda config: config.brdf.metals,
            on=lambda config: {"brdf.metals": True},
            off={"brdf.metals": False},
            obstacle=_without_reflection("a surface without reflection shows no metal"),
            cost=lambda config: "one more unknown at every point",
            risk="metal becomes dark gloss",
            unjudged=_free_light(UNKNOWN_IN_FREE_LIGHT),
            needs="reflection",
        ),
        Effect(
            name="varying-roughness",
            title="roughness that varies from place to place",
            is_on=lambda config: config.brdf.varying_roughness,
            on=lambda config: {"brdf.varying_roughness": True},
            off={"brdf.varying_roughness": False},
            obstacle=_without_reflection("a surface without reflection has no roughness"),
            cost=lambda config: "one more unknown at every point",
            risk="all gloss is as sharp as that in the middle",
            advised=True,
            unjudged=_free_light(UNKNOWN_IN_FREE_LIGHT),
            needs="reflection",
        ),
        Effect(
            name="lobe-sampling",
            title="directions drawn by the specular lobe",
            is_on=lambda config: config.shading.sampler in ("mis", "lobe"),
            on=lambda config: {"shading.sampler": "mis"},
            off={"shading.sampler": "no_lobe"},
            obstacle=_without_reflection("a surface without reflection has no lobe"),
            cost=lambda config: (
                f"the lobe's density in {config.shading.train_samples * config.train.rays} directions a step"
            ),
            risk="sharp reflections are noise",
            unjudged=_free_light(UNKNOWN_IN_FREE_LIGHT),
            needs="reflection",
        ),
        Effect(
            name="long-tails",
            title="the long tails of highlights (GGX)",
            is_on=lambda config: config.shading.lobe == "ggx",
            on=lambda config: {"shading.lobe": "ggx"},
            off={"shading.lobe": "spherical_gaussian"},
            obstacle=_without_reflection("a surface without reflection has no highlights"),
            cost=lambda config: "none",
            risk="the glow about highlights becomes roughness",
            unjudged=_free_light(UNKNOWN_IN_FREE_LIGHT),
            needs="reflection",
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
        Effect(
            name="exposure",
            title="exposure and white balance of each photograph",
            is_on=lambda config: config.optimizer.exposure > 0,
            on=lambda config: {"optimizer.exposure": config.optimizer.exposure or EXPOSURE_RATE},
            off={"optimizer.exposure": 0.0},
            obstacle=_none,
            cost=lambda config: "three unknowns for each photograph",
            risk="photographs of one place that differ become gloss, fog, and light that is uneven",
        ),
        Effect(
            name="response",
            title="pixels are display values, not radiance",
            is_on=lambda config: False,
            on=lambda config: {},
            off={},
            obstacle=lambda config: "told from the files, or by --response",
            cost=lambda config: "a curve over the pixels",
            risk="dark pixels count too much, and all light is wrong",
        ),
        Effect(
            name="joint-stage",
            title="surface and material trained together",
            is_on=lambda config: config.train.joint_steps > 0,
            on=lambda config: {},
            off={"train.joint_steps": 0},
            obstacle=_joint_obstacle,
            cost=lambda config: f"{config.train.joint_steps} steps that move everything",
            risk="the surface keeps the errors that shading shows",
            advised=True,
        ),
    )
}
"""By name, in the order of the table."""


def _every(config: NeilfConfig) -> int:
    return config.light.fit.every if isinstance(config.light, MapLightConfig) else 0
