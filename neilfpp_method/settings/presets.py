"""The presets: the published settings (`docs/paper.md`), `fast` for a laptop's CPU, and the slower `balanced`
and `best`.

Each preset is a mapping of the settings in which it differs from another one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from neilfpp_method.errors import UserError
from neilfpp_method.settings.plain import changed
from neilfpp_method.settings.types import FrequencyConfig, MeshConfig, NeilfConfig

__all__ = ["EXPOSURE_RATE", "POSE_FITS", "PRESETS", "fixed_geometry", "free_light", "preset"]

EXPOSURE_RATE = 1e-3
"""Learning rate of the log gains of photographs, if they are trained: 1 % takes Adam about ten steps."""
POSE_FITS = 12
"""Fits of the camera poses, if they are corrected. Each improves on the poses of the one before."""
SINE_FREQUENCY = 30.0
"""ω of the sine layers sin(ω (W x + b)) of B and L. In the published code ω is part of W and b, so a step
of Adam there corresponds to a step of 1/ω here.
"""

# Differences from the defaults of the settings.
PAPER_MLP: Mapping[str, Any] = {
    "preset": "paper-mlp",
    "light.monochrome": True,
    "background.kind": "none",
    "host.loss.points": "scene",
    "loss.normal_gradient": 0.1,
    "optimizer.brdf": 1e-3 / SINE_FREQUENCY,
    "optimizer.light": 1e-3 / SINE_FREQUENCY,
    "optimizer.joint": 0.3,
    "optimizer.final": (0.1, 1.0, 0.1),
    "optimizer.drops": (1, 0, 1),
    "train.sdf_steps": 8_000,
    "train.material_steps": 8_000,
    "train.joint_steps": 80_000,
}


def paper_mlp() -> NeilfConfig:
    """The published MLP setting for LDR images: 96k steps, 24 h on a V100 (`docs/paper.md`)."""
    return changed(NeilfConfig(), PAPER_MLP)


# Differences from paper-mlp: hash grids with small networks, and learning rates and steps for them.
PAPER_NGP: Mapping[str, Any] = {
    "preset": "paper-ngp",
    "encoding.kind": "hash",
    "host.sdf.layers": 2,
    "host.sdf.width": 64,
    "host.sdf.feature_width": 64,
    "radiance.width": 64,
    "brdf.layers": 2,
    "brdf.width": 120,
    "light.activation": "relu",
    "host.loss.point_cloud": 0.1,
    "host.loss.surface": (1e-2, 1e-4),
    "loss.position_gradient": 0.0,
    "optimizer.geometry": 1e-2,
    "optimizer.radiance": 1e-2,
    "optimizer.brdf": 1e-2,
    "optimizer.light": 1e-2,
    "optimizer.beta": 1e-2,
    "optimizer.joint": 0.1,
    "optimizer.final": (0.1, 0.1, 0.01),
    "optimizer.drops": (1, 1, 2),
    "optimizer.warm_up": 100,
    "train.sdf_steps": 5_000,
    "train.material_steps": 5_000,
    "train.joint_steps": 30_000,
}


def paper_ngp() -> NeilfConfig:
    """The published hash-grid setting for LDR images: 40k steps, 4 h on a V100. It expects a point cloud."""
    return changed(paper_mlp(), PAPER_NGP)


# Differences from paper-ngp.
PAPER_NGP_HDR: Mapping[str, Any] = {
    "preset": "paper-ngp-hdr",
    "background.kind": "inverted_sphere",
    "host.loss.surface": (1e-3, 1e-4),
    "loss.smoothness": 0.0,
    "loss.lambertian": 0.0,
    "loss.position_gradient": 0.1,
    "optimizer.final": (0.1, 0.1, 1e-3),
    "optimizer.drops": (1, 1, 3),
    "train.joint_steps": 40_000,
}


def paper_ngp_hdr() -> NeilfConfig:
    """The published hash-grid setting for HDR photographs with a background: 50k steps."""
    return changed(paper_ngp(), PAPER_NGP_HDR)


# Differences from the defaults of the settings.
FAST: Mapping[str, Any] = {
    "preset": "fast",
    "encoding.kind": "hash",
    "encoding.levels": 8,
    "encoding.log2_entries": 16,
    "encoding.sdf_log2_entries": 18,
    "encoding.max_resolution": 256,
    "host.sdf.layers": 1,
    "host.sdf.start": "hull",
    "host.sdf.width": 64,
    "host.sdf.feature_width": 15,
    "radiance.positions": "encoded",
    "radiance.direction": "mirrored",
    "radiance.layers": 2,
    "radiance.width": 64,
    "brdf.initial_base_color": 0.3,
    "brdf.initial_metallic": 0.1,
    "brdf.layers": 2,
    "brdf.width": 64,
    "light": {
        "kind": "auto",
        "environment_height": 48,
        "fit": {"every": 150},
    },
    "background.samples": 16,
    "background.radius": 1.75,
    "host.volume.density": "auto",
    "host.volume.beta_init": 0.05,
    "host.volume.beta_final": 0.004,
    "host.volume.skip_empty": True,
    "host.volume.samples": 32,
    "shading.lobe": "ggx",
    "shading.normals": "refined",
    "shading.sampler": "mis",
    "shading.train_samples": 64,
    "shading.eval_samples": 128,
    "loss.unit": "median",
    "loss.volume": 2.0,
    "host.loss.eikonal": 0.05,
    "host.loss.hessian": (2e-4, 1.6e-3, 1.6e-3),
    "host.loss.surface": (1e-2, 1e-3),
    "host.loss.point_cloud": 0.1,
    "host.loss.patches": 0.5,
    "host.loss.mask": 1.0,
    "loss.lambertian": 0.0,
    "loss.position_gradient": 0.0,
    "loss.normal_gradient": 0.0,
    # In the short joint stage geometry keeps the learning rate with which SDF init ended.
    "optimizer.geometry": 2e-2,
    "optimizer.radiance": 5e-3,
    "optimizer.brdf": 1e-2,
    "optimizer.light": 3e-2,
    "optimizer.beta": 1e-3,
    "optimizer.exposure": EXPOSURE_RATE,
    "optimizer.joint": 0.1,
    "optimizer.background_from": 0.5,
    "train.sdf_steps": 4_000,
    "train.pose_fits": POSE_FITS,
    "train.material_steps": 3_000,
    "train.joint_steps": 300,
    "train.rays": 512,
}


def fast() -> NeilfConfig:
    """Settings for minutes on two CPU cores: small hash grids, few rays, and a simpler light.

    The light is an environment map with traced inter-reflection, and lamps if the images show that they are
    needed. `free_light` replaces it by the paper's light field.
    """
    return changed(NeilfConfig(), FAST)


# Differences from fast.
BALANCED: Mapping[str, Any] = {
    "preset": "balanced",
    "encoding.log2_entries": 17,
    "encoding.sdf_log2_entries": 19,
    "encoding.max_resolution": 512,
    "host.volume.samples": 48,
    "shading.eval_samples": 256,
    "light.fit.points": 2048,
    "light.fit.every": 250,
    "train.sdf_steps": 8_000,
    "train.material_steps": 6_000,
    "train.joint_steps": 400,
    "train.rays": 1024,
}


def balanced() -> NeilfConfig:
    """`fast` with more steps, more rays, finer grids, and more directions in evaluation.

    Method and learning rates are the same. docs/budget.md has the time that it takes.
    """
    return changed(fast(), BALANCED)


# Differences from balanced.
BEST: Mapping[str, Any] = {
    "preset": "best",
    "encoding.levels": 10,
    "encoding.log2_entries": 18,
    "encoding.sdf_log2_entries": 20,
    "encoding.max_resolution": 1024,
    "radiance.width": 128,
    "brdf.width": 128,
    "host.volume.samples": 64,
    "shading.train_samples": 128,
    "light.fit.every": 500,
    "train.sdf_steps": 20_000,
    "train.material_steps": 12_000,
    "train.joint_steps": 2_000,
    "train.rays": 2048,
}


def best() -> NeilfConfig:
    """`balanced` with more of each again, for a GPU or a night of computation (docs/budget.md)."""
    return changed(balanced(), BEST)


PRESETS: Mapping[str, Callable[[], NeilfConfig]] = {
    "fast": fast,
    "balanced": balanced,
    "best": best,
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


# Differences from fast. A network needs a lower learning rate than the texels of a map.
FREE_LIGHT: Mapping[str, Any] = {
    "light": {
        "kind": "free",
        "layers": 4,
        "width": 64,
        "rays_per_point": 0.25,
    },
    "optimizer.light": 5e-3,
}


def free_light(config: NeilfConfig) -> NeilfConfig:
    """Replace the light of `fast` by the paper's: a field that is free at every point, constrained by L_ref.

    It needs no optional method of the host.
    """
    return changed(config, FREE_LIGHT)


def fixed_geometry(config: NeilfConfig) -> NeilfConfig:
    """Adapt a preset to geometry that is given as a mesh.

    - Stages: R is trained first for a few steps, because light between surfaces influences the choice of the
      light; then R, B and L are trained together, in the steps of both other stages.
    - R gets no feature of G, so it encodes positions itself, in a larger network.
    - The normals are given: they are not refined, and R need not support their recovery.
    - Rays through a mesh are cheap, so the light is solved for more often.
    """
    train = config.train
    mesh = {
        "preset": f"{config.preset}-mesh",
        "host": {"kind": MeshConfig().kind},
        "radiance": {"positions": "encoded", "layers": 4, "width": 128, "direction": "outgoing"},
        "shading.normals": "host",
        "loss.lambertian": 10.0 * config.loss.lambertian,
        "train.sdf_steps": train.sdf_steps // 20,
        "train.material_steps": train.material_steps + train.joint_steps,
        "train.joint_steps": 0,
        "train.pose_fits": 0,
    }
    if config.light.kind != "free":
        mesh["light.fit.every"] = 100
    given = changed(config, mesh)
    return as_published_on_a_mesh(given) if config.preset.startswith("paper-") else given


# Further differences of the paper's presets with a mesh: three stages with one learning rate, more rays, and
# the surface light field of the paper as R.
PAPER_MESH: Mapping[str, Any] = {
    "background.kind": "auto",
    "radiance.layers": 8,
    "loss.smoothness": 5e-4,
    "loss.lambertian": 5e-3,
    "loss.position_gradient": 0.0,
    "loss.normal_gradient": 0.0,
    "optimizer.geometry": 2e-3,
    "optimizer.radiance": 2e-3,
    "optimizer.brdf": 2e-3,
    "optimizer.light": 2e-3,
    "optimizer.beta": 2e-3,
    "optimizer.joint": 1.0,
    "optimizer.final": (1.0, 1.0, 0.04),
    "optimizer.drops": (0, 0, 2),
    "optimizer.warm_up": 0,
    "train.sdf_steps": 5_000,
    "train.material_steps": 1_000,
    "train.joint_steps": 30_000,
    "train.rays": 8192,
}


def as_published_on_a_mesh(config: NeilfConfig) -> NeilfConfig:
    """Apply the settings that the published run on given geometry changes, coloured light among them."""
    published = dict(PAPER_MESH)
    if isinstance(config.encoding, FrequencyConfig):
        published |= {name: 2e-3 / SINE_FREQUENCY for name in ("optimizer.brdf", "optimizer.light")}
    if config.light.kind == "free":
        published["light.monochrome"] = False
    return changed(config, published)
