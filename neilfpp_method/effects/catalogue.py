"""The effects that can be simulated or left out, as data. Switching an effect is a change of settings."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from neilfpp_method.settings.plain import changed
from neilfpp_method.settings.presets import EXPOSURE_RATE, POSE_FITS
from neilfpp_method.settings.types import FreeLightConfig, MapLightConfig, MeshConfig, NeilfConfig

__all__ = ["EFFECTS", "Effect", "switched"]


@dataclass(frozen=True)
class Effect:
    """A property of the scene or of light transport that can be simulated or left out.

    Attributes:
        name: name on the command line and in `effects.json`.
        title: description for the report.
        is_on: function of the settings: whether they simulate the effect or leave it to evidence.
        on: the settings that switch it on.
        off: function of the settings: those that switch it off.
        obstacle: function of the settings: the reason why the effect cannot be switched; empty if it can.
        cost: function of the settings: the additional computation while material is trained.
        risk: the error of the result if the effect is left out although the scene has it.
        not_measured: function of the settings: the reason why no evidence is collected; empty if it is.
        advised: whether evidence is reported but never changes the effect, because it cannot show reliably
            that the effect is not needed.
        requires_gain: whether the effect is on only if its gain is significantly above the threshold. Other
            effects stay on unless their gain is significantly below it.
        may_switch_on: whether evidence may switch the effect on although the settings leave it out. Evidence
            on other effects only switches off what the settings simulate.
        needs: name of the effect that this one requires; empty if it requires none.
        solved: whether the light solver decides the effect at every fit, so that evidence changes no
            setting.
    """

    name: str
    title: str
    is_on: Callable[[NeilfConfig], bool]
    on: Callable[[NeilfConfig], Mapping[str, Any]]
    off: Callable[[NeilfConfig], Mapping[str, Any]]
    obstacle: Callable[[NeilfConfig], str]
    cost: Callable[[NeilfConfig], str]
    risk: str
    not_measured: Callable[[NeilfConfig], str] = lambda config: ""
    solved: bool = False
    advised: bool = False
    requires_gain: bool = False
    may_switch_on: bool = False
    needs: str = ""


def switched(config: NeilfConfig, effect: Effect, on: bool) -> NeilfConfig:
    """The same settings with one effect switched on or off."""
    return changed(config, effect.on(config) if on else effect.off(config))


def _none(config: NeilfConfig) -> str:
    return ""


def _traced_on(config: NeilfConfig) -> Mapping[str, Any]:
    default, mode = type(config.light)().inter_reflection, config.light.inter_reflection
    return {"light.inter_reflection": default if mode == "off" else mode}


def _traced_cost(config: NeilfConfig) -> str:
    points = config.train.rays
    if isinstance(config.light, FreeLightConfig):
        return f"{config.light.rays_per_point * points:.0f} rendered rays a step"
    return f"{config.shading.train_samples * points} traced rays a step"


def _free_light(what: str) -> Callable[[NeilfConfig], str]:
    return lambda config: what if isinstance(config.light, FreeLightConfig) else ""


def _is_map(config: NeilfConfig) -> bool:
    return isinstance(config.light, MapLightConfig)


def _without_reflection(what: str) -> Callable[[NeilfConfig], str]:
    return lambda config: "" if config.shading.specular else what


def _has_long_tails(config: NeilfConfig) -> bool:
    return config.shading.lobe != "spherical_gaussian"


def _map_on(config: NeilfConfig) -> Mapping[str, Any]:
    height = config.light.environment_height
    return {"light.environment_height": height if height > 1 else MapLightConfig().environment_height}


def _given_map(config: NeilfConfig) -> str:
    return "the map is given" if config.known_map is not None else ""


def _joint_obstacle(config: NeilfConfig) -> str:
    if isinstance(config.host, MeshConfig):
        return "the surface is given, so material and R are trained together from the start"
    return "" if config.train.joint_steps else "the settings give it no steps (train.joint_steps)"


def _pose_obstacle(config: NeilfConfig) -> str:
    if isinstance(config.host, MeshConfig):
        return "the surface is given, and poses are fitted only while it is trained"
    return "" if config.train.sdf_steps else "poses are fitted in SDF init, which has no steps"


UNKNOWN_IN_FREE_LIGHT = "not measured: a light that is free at every point can explain any material"
"""Why no evidence on the material is collected with the paper's light field."""

EFFECTS: Mapping[str, Effect] = {
    effect.name: effect
    for effect in (
        Effect(
            name="inter-reflection",
            title="shadows and inter-reflection",
            is_on=lambda config: config.light.inter_reflection != "off",
            on=_traced_on,
            off=lambda config: {"light.inter_reflection": "off"},
            obstacle=_none,
            cost=_traced_cost,
            risk="shadows and light between surfaces are baked into the base colour",
        ),
        Effect(
            name="lamps",
            title="near lamps",
            is_on=lambda config: isinstance(config.light, MapLightConfig) and config.light.kind != "distant",
            on=lambda config: {"light.kind": "distant_near"},
            off=lambda config: {"light.kind": "distant"},
            obstacle=_free_light("a light that is free at every point includes that of lamps"),
            cost=lambda config: "a search for their places, and a shadow ray per point and lamp",
            risk="the light of near lamps is baked into the base colour",
            solved=True,
        ),
        Effect(
            name="environment-map",
            title="an environment map instead of even light",
            is_on=lambda config: _is_map(config) and config.light.environment_height > 1,
            on=_map_on,
            off=lambda config: {"light.environment_height": 1},
            obstacle=lambda config: (
                _free_light("a light that is free at every point is not a map")(config) or _given_map(config)
            ),
            cost=lambda config: (
                f"{config.shading.train_samples * config.train.rays} map look-ups a step, and fits of "
                f"{2 * config.light.environment_height**2} texels"
                if _is_map(config)
                else ""
            ),
            risk="shading and reflections are baked into the base colour",
            advised=True,
        ),
        Effect(
            name="coloured-light",
            title="a coloured map instead of grey light",
            is_on=lambda config: not config.light.monochrome,
            on=lambda config: {"light.monochrome": False},
            off=lambda config: {"light.monochrome": True},
            obstacle=_given_map,
            cost=lambda config: "three unknowns per texel instead of one",
            risk="the colours of the light are baked into the base colour",
            advised=True,
            not_measured=_free_light(UNKNOWN_IN_FREE_LIGHT),
        ),
        Effect(
            name="reflection",
            title="specular reflection",
            is_on=lambda config: config.shading.specular,
            on=lambda config: {"shading.specular": True},
            off=lambda config: {"shading.specular": False},
            obstacle=_none,
            cost=lambda config: (
                f"the specular lobe in {config.shading.train_samples * config.train.rays} directions a step, "
                "and three transport matrices per fit of the light instead of one"
            ),
            risk="highlights are baked into the base colour",
            advised=True,
            not_measured=_free_light(UNKNOWN_IN_FREE_LIGHT),
        ),
        Effect(
            name="metals",
            title="metals",
            is_on=lambda config: config.brdf.metals,
            on=lambda config: {"brdf.metals": True},
            off=lambda config: {"brdf.metals": False},
            obstacle=_without_reflection("surfaces without specular reflection have no metallic"),
            cost=lambda config: "one more unknown at every point",
            risk="metal becomes a dark glossy dielectric",
            not_measured=_free_light(UNKNOWN_IN_FREE_LIGHT),
            needs="reflection",
            requires_gain=True,
        ),
        Effect(
            name="varying-roughness",
            title="roughness that varies over the surface",
            is_on=lambda config: config.brdf.varying_roughness,
            on=lambda config: {"brdf.varying_roughness": True},
            off=lambda config: {"brdf.varying_roughness": False},
            obstacle=_without_reflection("surfaces without specular reflection have no roughness"),
            cost=lambda config: "one more unknown at every point",
            risk="all highlights have the average sharpness",
            advised=True,
            not_measured=_free_light(UNKNOWN_IN_FREE_LIGHT),
            needs="reflection",
        ),
        Effect(
            name="lobe-sampling",
            title="importance sampling of the specular lobe",
            is_on=lambda config: config.shading.sampler in ("mis", "lobe"),
            on=lambda config: {"shading.sampler": "mis"},
            off=lambda config: {"shading.sampler": "no_lobe"},
            obstacle=_without_reflection("surfaces without specular reflection have no lobe"),
            cost=lambda config: (
                f"the pdf of the lobe in {config.shading.train_samples * config.train.rays} directions a step"
            ),
            risk="sharp reflections are noisy",
            not_measured=_free_light(UNKNOWN_IN_FREE_LIGHT),
            needs="reflection",
        ),
        Effect(
            name="long-tails",
            title="the long tails of highlights (GGX)",
            is_on=_has_long_tails,
            on=lambda config: {} if _has_long_tails(config) else {"shading.lobe": "ggx"},
            off=lambda config: {"shading.lobe": "spherical_gaussian"},
            obstacle=_without_reflection("surfaces without specular reflection have no highlights"),
            cost=lambda config: "none",
            risk="the wide tails of highlights are explained by more roughness",
            not_measured=_free_light(UNKNOWN_IN_FREE_LIGHT),
            needs="reflection",
        ),
        Effect(
            name="rough-diffuse",
            title="diffuse reflection that depends on the roughness (Disney)",
            is_on=lambda config: config.shading.lobe == "ggx_burley",
            on=lambda config: {"shading.lobe": "ggx_burley"},
            off=lambda config: {"shading.lobe": "ggx"} if _has_long_tails(config) else {},
            obstacle=_without_reflection("surfaces without specular reflection have no roughness"),
            cost=lambda config: (
                f"the diffuse lobe in {config.shading.train_samples * config.train.rays} directions a step"
            ),
            risk="at flat angles, smooth paint is too bright and rough paint too dark",
            not_measured=_free_light(UNKNOWN_IN_FREE_LIGHT),
            requires_gain=True,
            may_switch_on=True,
            needs="long-tails",
        ),
        Effect(
            name="background",
            title="an open background",
            is_on=lambda config: config.background.kind != "constant",
            on=lambda config: {"background.kind": "inverted_sphere"},
            off=lambda config: {"background.kind": "constant"},
            obstacle=lambda config: (
                "R represents the background on the scene sphere" if config.background.kind == "none" else ""
            ),
            cost=lambda config: f"{config.background.samples} network queries per ray",
            risk="the background becomes surfaces within the scene",
        ),
        Effect(
            name="exposure",
            title="exposure and white balance of each photograph",
            is_on=lambda config: config.optimizer.exposure > 0,
            on=lambda config: {"optimizer.exposure": config.optimizer.exposure or EXPOSURE_RATE},
            off=lambda config: {"optimizer.exposure": 0.0},
            obstacle=_none,
            cost=lambda config: "three unknowns per photograph",
            risk="differences of exposure become gloss, fog and uneven light",
        ),
        Effect(
            name="poses",
            title="errors of the camera poses",
            is_on=lambda config: config.train.pose_fits > 0,
            on=lambda config: {"train.pose_fits": config.train.pose_fits or POSE_FITS},
            off=lambda config: {"train.pose_fits": 0},
            obstacle=_pose_obstacle,
            cost=lambda config: f"{config.train.pose_fits} fits of all cameras while G is trained",
            risk="surfaces and colours are blurred",
            requires_gain=True,
        ),
        Effect(
            name="response",
            title="pixels that hold display values instead of radiance",
            is_on=lambda config: False,
            on=lambda config: {},
            off=lambda config: {},
            obstacle=lambda config: "set by the image files or --response",
            cost=lambda config: "the sRGB curve on every pixel",
            risk="radiance, and with it all light, is wrong",
        ),
        Effect(
            name="joint-stage",
            title="joint training of surface and material",
            is_on=lambda config: config.train.joint_steps > 0,
            on=lambda config: {},
            off=lambda config: {"train.joint_steps": 0},
            obstacle=_joint_obstacle,
            cost=lambda config: f"{config.train.joint_steps} steps that train all fields",
            risk="errors of the surface that only shading reveals remain",
            advised=True,
        ),
    )
}
"""All effects by name, in the order of the table."""
