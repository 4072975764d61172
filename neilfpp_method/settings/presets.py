"""The presets: the published settings (`docs/paper.md`), and one for a laptop."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping

from neilfpp_method.errors import UserError
from neilfpp_method.settings.types import (
    BackgroundConfig,
    BrdfConfig,
    HashGridConfig,
    IncidentLightConfig,
    InterReflectionConfig,
    LightFitConfig,
    LossConfig,
    NeilfConfig,
    OptimizerConfig,
    OutgoingRadianceConfig,
    SdfConfig,
    ShadingConfig,
    TrainConfig,
    VolumeConfig,
)

SINE_FREQUENCY = 30.0
"""ω of the sine layers sin(ω (W x + b)) of B and L. In the published code ω is part of W and b, so that a step of Adam there
is one of 1/ω here."""

__all__ = ["PRESETS", "fixed_geometry", "free_light", "preset"]


def paper_mlp() -> NeilfConfig:
    """The published MLP setting, for display images: 96k steps, 24 h on a V100. `docs/paper.md` has it line by line."""
    return NeilfConfig(
        preset="paper-mlp",
        light=IncidentLightConfig(monochrome=True),
        background=BackgroundConfig(kind="none"),
        loss=LossConfig(points="scene", surface_epsilon=10.0, normal_gradient=0.1),
        optimizer=OptimizerConfig(
            brdf=1e-3 / SINE_FREQUENCY,
            light=1e-3 / SINE_FREQUENCY,
            joint=0.3,
            final=(0.1, 1.0, 0.1),
            drops=(1, 0, 1),
        ),
        train=TrainConfig(sdf_steps=8_000, material_steps=8_000, joint_steps=80_000),
    )


def paper_ngp() -> NeilfConfig:
    """The published hash-grid setting, for display images: 40k steps, 4 h on a V100; it asks for a point cloud."""
    replace, mlp = dataclasses.replace, paper_mlp()
    return replace(
        mlp,
        preset="paper-ngp",
        sdf=SdfConfig(encoding="hash", layers=2, width=64, skip=None, feature_width=64),
        radiance=OutgoingRadianceConfig(layers=4, width=64, direction_encoding="spherical_harmonics"),
        brdf=BrdfConfig(encoding="hash", activation="relu", layers=2, width=120, skip=None),
        light=replace(mlp.light, activation="relu", direction_encoding="spherical_harmonics", direction_degree=4),
        loss=replace(mlp.loss, point_cloud=0.1, surface=1e-2, position_gradient=0.0, hessian_method="finite_difference"),
        optimizer=OptimizerConfig(*(6 * [1e-2]), joint=0.1, final=(0.1, 0.1, 0.01), drops=(1, 1, 2), warm_up=100),
        train=TrainConfig(sdf_steps=5_000, material_steps=5_000, joint_steps=30_000),
    )


def paper_ngp_hdr() -> NeilfConfig:
    """The published hash-grid setting for photographs of linear radiance with a background: 50k steps."""
    replace, ngp = dataclasses.replace, paper_ngp()
    return replace(
        ngp,
        preset="paper-ngp-hdr",
        background=BackgroundConfig(kind="inverted_sphere", layers=2, width=64),
        loss=replace(ngp.loss, surface=1e-3, smoothness=0.0, lambertian=0.0, position_gradient=0.1),
        optimizer=replace(ngp.optimizer, final=(0.1, 0.1, 1e-3), drops=(1, 1, 3)),
        train=replace(ngp.train, joint_steps=40_000),
    )


def fast() -> NeilfConfig:
    """Minutes on the two cores of a laptop: the same method with small hash grids, few rays, and as much light as most
    scenes need: an environment map, what the scene reflects, and lamps close by where the images ask for them. `free_light`
    has the paper's light field for it."""
    grid = HashGridConfig(levels=8, log2_entries=16, base_resolution=16, max_resolution=256)
    return NeilfConfig(
        preset="fast",
        # The surface is all of a scene that is seen, and a table without collisions costs no more to read.
        sdf=SdfConfig(
            encoding="hash", grid=dataclasses.replace(grid, log2_entries=18), layers=1, width=64, skip=None, feature_width=15
        ),
        radiance=OutgoingRadianceConfig(
            encoding="hash",
            grid=grid,
            layers=2,
            width=64,
            direction="mirrored",
            direction_encoding="spherical_harmonics",
        ),
        brdf=BrdfConfig(
            encoding="hash",
            initial_base_color=0.3,
            initial_metallic=0.1,
            grid=grid,
            activation="relu",
            layers=2,
            width=64,
            skip=None,
        ),
        light=IncidentLightConfig(
            kind="auto",
            environment_height=48,
            fit=LightFitConfig(smoothness=0.02, every=150),
            layers=4,
            width=64,
            direction_encoding="spherical_harmonics",
            direction_degree=5,
        ),
        background=BackgroundConfig(layers=4, width=64, samples=16),
        volume=VolumeConfig(
            radius=1.75,
            beta_init=0.05,
            skip_empty=True,
            initial_samples=64,
            narrowed_samples=32,
            rounds=2,
            bisections=5,
            samples=32,
            normal_radius=0.15,
        ),
        shading=ShadingConfig(sampler="mis", train_samples=32, eval_samples=128),
        inter_reflection=InterReflectionConfig(mode="hard", rays_per_point=0.25),
        loss=LossConfig(
            unit="median",
            volume=2.0,
            eikonal=0.05,
            hessian=2e-4,
            hessian_growth=8.0,
            hessian_joint=1.6e-3,
            surface=1e-2,
            surface_joint=1e-3,
            mask=0.1,
            smoothness=0.0,
            lambertian=0.0,
            position_gradient=0.0,
            normal_gradient=0.1,
            hessian_method="finite_difference",
        ),
        # The joint stage is short: geometry goes on at the rate that SDF init ended with, and is not stirred up again.
        optimizer=OptimizerConfig(
            geometry=2e-2,
            radiance=5e-3,
            brdf=5e-3,
            light=3e-2,
            background=1e-3,
            beta=1e-3,
            joint=0.1,
            background_from=0.5,
        ),
        train=TrainConfig(sdf_steps=2_000, material_steps=1_500, joint_steps=100, rays=512, fresh=0.25),
    )


PRESETS: Mapping[str, Callable[[], NeilfConfig]] = {
    "fast": fast,
    "paper-mlp": paper_mlp,
    "paper-ngp": paper_ngp,
    "paper-ngp-hdr": paper_ngp_hdr,
}


def preset(name: str) -> NeilfConfig:
    """The settings of a preset by name.

    Raises:
        UserError: no preset has this name.
    """
    if name not in PRESETS:
        raise UserError(f"unknown preset '{name}'", f"choose one of {', '.join(PRESETS)}")
    return PRESETS[name]()


def free_light(config: NeilfConfig) -> NeilfConfig:
    """`fast` with the paper's light: a field that is free at every point, tied to the scene by L_ref.

    It asks nothing of the host but `render`. A network takes smaller steps than the texels of a map.
    """
    return dataclasses.replace(
        config,
        light=dataclasses.replace(config.light, kind="free"),
        inter_reflection=dataclasses.replace(config.inter_reflection, mode="soft"),
        optimizer=dataclasses.replace(config.optimizer, light=5e-3),
    )


def fixed_geometry(config: NeilfConfig) -> NeilfConfig:
    """A preset for geometry that is given as a mesh: R alone for a while, as the light is chosen by what surfaces send each
    other, then one stage in which R, B and L move together.

    R has no feature of G that knows the place, so it encodes positions as G would; 8×128 is the paper's surface light
    field. A surface without thickness needs no distance to leave it, and what leaves it is known well enough to learn
    from L_ref (METHOD §2, §4). Its normals are taken as they are, so R need not help to find them. R is new as well, so
    there are twice as many steps with a material. Rays through a mesh are cheap, so light is solved for more often.
    """
    replace, train = dataclasses.replace, config.train
    given = replace(
        config,
        preset=f"{config.preset}-mesh",
        host="mesh",
        radiance=replace(
            config.radiance,
            encoding=config.sdf.encoding,
            frequencies=config.sdf.frequencies,
            layers=8,
            width=128,
            direction="outgoing",
        ),
        light=replace(config.light, fit=replace(config.light.fit, every=100)),
        volume=replace(config.volume, normal_radius=0.0),
        inter_reflection=replace(config.inter_reflection, radiance_gradient=0.7, offset=2e-3),
        loss=replace(config.loss, lambertian=10.0 * config.loss.lambertian),
        train=replace(
            train,
            sdf_steps=train.sdf_steps // 10,
            material_steps=2 * (train.material_steps + train.joint_steps),
            joint_steps=0,
        ),
    )
    return as_published_on_a_mesh(given) if config.preset.startswith("paper-") else given


def as_published_on_a_mesh(config: NeilfConfig) -> NeilfConfig:
    """What the published run on given geometry sets in its own way: light in colour, three stages at one rate, more rays."""
    replace, sine = dataclasses.replace, config.brdf.activation == "sine"
    slow = 2e-3 / SINE_FREQUENCY if sine else 2e-3
    rates = replace(OptimizerConfig(*(6 * [2e-3])), brdf=slow, light=slow, final=(1.0, 1.0, 0.04), drops=(0, 0, 2))
    return replace(
        config,
        light=replace(config.light, monochrome=False),
        background=replace(config.background, kind="auto"),
        loss=replace(config.loss, smoothness=5e-4, lambertian=5e-3, position_gradient=0.0, normal_gradient=0.0),
        optimizer=rates,
        train=replace(config.train, sdf_steps=5_000, material_steps=1_000, joint_steps=30_000, rays=8192),
    )
