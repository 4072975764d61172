"""Every setting, one dataclass per room; `settings.presets` has the sets of them.

Lengths are in scene units (the object lies in the unit sphere). A setting with `kind`, `mode` or a `bool` is
a switch: an effect that is switched off asks no network and traces no ray.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

import tyro

__all__ = ["NeilfConfig"]


# ----------------------------------------------------------------------------------------------------- fields


@dataclass(frozen=True)
class FrequencyConfig:
    """Positions by sines and cosines, six octaves: the paper's MLP setting; B then has sine units (SIREN)."""

    kind: Literal["frequency"] = "frequency"
    """frequency or hash: how G, R and B see positions."""


@dataclass(frozen=True)
class HashGridConfig:
    """Positions by multiresolution hash grids: one each for G, B and, where encoded, R (Müller 2022)."""

    kind: Literal["hash"] = "hash"
    """frequency or hash: how G, R and B see positions."""
    levels: int = 16
    """Number of grids, coarse to fine."""
    log2_entries: int = 19
    """Table size of one level, as a power of two."""
    sdf_log2_entries: int = 19
    """The same for G. Only the surface of a scene is seen, and a table without collisions costs no more."""
    max_resolution: int = 4096
    """Cells along an edge of the scene's cube at the finest level; at the coarsest there are 16."""


EncodingConfig = Annotated[FrequencyConfig | HashGridConfig, tyro.conf.AvoidSubcommands]


@dataclass(frozen=True)
class SdfConfig:
    """G: position → signed distance and a feature for R (METHOD §5)."""

    layers: int = 8
    """Hidden layers."""
    width: int = 256
    """Units of a hidden layer."""
    feature_width: int = 256
    """Length of the feature handed to R."""
    start: Literal["sphere", "silhouettes"] = "sphere"
    """silhouettes: before SDF init the field is fitted to the visual hull of the masks, where given."""


@dataclass(frozen=True)
class OutgoingRadianceConfig:
    """R: position, direction, normal and feature of G → linear RGB (METHOD §5)."""

    positions: Literal["raw", "encoded"] = "raw"
    """raw: R has no encoding of its own, and reads that of G by the feature. encoded: it has one of the kind
    that `encoding` says, as it always has where there is no feature.
    """
    direction: Literal["outgoing", "mirrored"] = "outgoing"
    """Which direction is encoded: the outgoing one, as in the paper, or the one that it mirrors about the
    normal. What a shiny surface sends changes evenly with the latter, so its normals are found (Verbin et al.
    2022, "Ref-NeRF").
    """
    layers: int = 4
    """Hidden layers."""
    width: int = 256
    """Units of a hidden layer."""


@dataclass(frozen=True)
class BrdfConfig:
    """B: position → base colour, roughness, metallic (METHOD §5)."""

    initial_base_color: float = 0.5
    """Initial base colour. Images hardly tell its scale from the light's, so it stays near this."""
    initial_metallic: float = 0.5
    """Initial metallic. Most surfaces are no metals; light found under metals is too weak for others."""
    metals: bool = True
    """Whether there may be metal; off, metallic is 0 everywhere."""
    varying_roughness: bool = True
    """Whether roughness is a field; off, the whole scene has one, which is learned."""
    layers: int = 8
    """Hidden layers."""
    width: int = 512
    """Units of a hidden layer."""


@dataclass(frozen=True)
class LightFitConfig:
    """How an environment map, and lamps before it, are solved for (`lighting`)."""

    points: int = 1024
    """Surface points that the light is fitted to; memory and time grow with points · texels."""
    every: int = 100
    """Steps between two fits."""
    steps: int = 100
    """Steps of a fit."""
    smoothness: float = 0.03
    """Weight of the total variation of log radiance, per texel, against the relative error."""
    whiteness: float = 0.05
    """Weight of the tint of all light that reaches the points, against the relative error: images hardly tell
    the tint of the light from that of the surfaces.
    """
    evenness: float = 0.3
    """Weight of the mean difference of log base colour between neighbouring points, against the relative
    error. The base colour of every point is free while light is fitted; 0: it is what surfaces have learned,
    up to a factor per channel.
    """


@dataclass(frozen=True)
class MapLightConfig:
    """L: an environment map, and perhaps lamps before it. It goes with inter-reflection hard or off."""

    kind: Literal["distant", "distant_near", "auto"] = "auto"
    """free: its own light at every point (the paper). distant: an environment map. distant_near: a map, and
    lamps close to the scene. auto: a map, and lamps where points that were kept back from the fit ask for
    them.
    """
    environment_height: int = 32
    """Rows of the environment map; it has twice as many columns. 1: one colour from everywhere."""
    monochrome: bool = False
    """One channel for all three colours; lamps keep theirs."""
    map: str | None = None
    """An environment map that is known, a linear EXR in the layout of docs/light.md; none: the map is
    recovered. Lamps before it are sought where `kind` says so.
    """
    fit: LightFitConfig = field(default_factory=LightFitConfig)
    """How the map is found."""


@dataclass(frozen=True)
class FreeLightConfig:
    """L: the paper's field, its own light at each point (METHOD §5): sharp in direction, smooth in x."""

    kind: Literal["free"] = "free"
    """free: its own light at every point (the paper). distant: an environment map. distant_near: a map, and
    lamps close to the scene. auto: a map, and lamps where points that were kept back from the fit ask for
    them.
    """
    activation: Literal["sine", "relu"] = "sine"
    """Hidden units; sine is SIREN's, with ω = 30."""
    layers: int = 8
    """Hidden layers; the position enters at the middle one."""
    width: int = 128
    """Units of a hidden layer."""
    monochrome: bool = False
    """One channel for all three colours; lamps keep theirs."""


IncidentLightConfig = Annotated[FreeLightConfig | MapLightConfig, tyro.conf.AvoidSubcommands]


@dataclass(frozen=True)
class BackgroundConfig:
    """What a ray sees beyond the scene."""

    kind: Literal["auto", "none", "constant", "inverted_sphere"] = "auto"
    """none: R paints the scene sphere, which closes the scene. constant: one colour. inverted_sphere: a
    NeRF++ field. auto: constant where one colour is all that the borders of the images show behind the scene,
    else inverted_sphere.
    """
    color: tuple[float, float, float] | None = None
    """Linear RGB of a constant background and initial inverted_sphere; none: from the image borders."""
    layers: int = 8
    """Hidden layers of the NeRF++ field."""
    width: int = 256
    """Units of a hidden layer of the NeRF++ field."""
    samples: int = 32
    """Samples per ray beyond the scene sphere."""


# ------------------------------------------------------------------------------------------------------ hosts


@dataclass(frozen=True)
class VolSdfConfig:
    """Geometry is found: a distance field that is rendered as a volume (`volume`)."""

    kind: Literal["volsdf"] = "volsdf"
    """volsdf or mesh: where geometry comes from."""
    sdf: SdfConfig = field(default_factory=SdfConfig)


@dataclass(frozen=True)
class MeshConfig:
    """Geometry is given: triangles as they are."""

    kind: Literal["mesh"] = "mesh"
    """volsdf or mesh: where geometry comes from."""
    path: str | None = None
    """The triangle mesh, in the world frame of the capture; none: the capture's inputs/model/mesh.ply.
    Normals are interpolated between its vertices, edges kept.
    """


HostConfig = Annotated[VolSdfConfig | MeshConfig, tyro.conf.AvoidSubcommands]


@dataclass(frozen=True)
class VolumeConfig:
    """Volume rendering of the VolSDF host (METHOD §3)."""

    radius: float = 3.0
    """Where the scene ends."""
    beta_init: float = 0.1
    """Scale of the Laplace density at the start."""
    skip_empty: bool = False
    """Rays skip what a coarse grid of the SDF shows to be empty; pictures, too, on a grid of their own."""
    initial_samples: int = 128
    """SDF queries per ray of the first round; also those added in each refinement. Half as many for rays that
    skip empty space: what is left of them is short.
    """
    rounds: int = 5
    """Most refinement rounds."""
    samples: int = 98
    """Samples per ray that are rendered: two thirds where it is stopped, the rest even, ends included."""
    normal_radius: float = 0.0
    """Surfaces are shaded with the normal of this neighbourhood, edges kept; 0: that of the hit."""


# ---------------------------------------------------------------------------------------------------- shading


@dataclass(frozen=True)
class ShadingConfig:
    """The rendering equation (METHOD §1)."""

    lobe: Literal["spherical_gaussian", "ggx"] = "spherical_gaussian"
    """Distribution and masking of the specular lobe."""
    specular: bool = True
    """Off: a Lambertian surface; roughness and metallic are not asked for."""
    sampler: Literal["fibonacci", "cosine", "lobe", "mis", "no_lobe"] = "fibonacci"
    """Who draws the incident directions: the paper's lattice, a cosine, the specular lobe; mis: cosine, lobe
    and (where it can be sampled) light by the balance heuristic; no_lobe: cosine and light.
    """
    train_samples: int = 128
    """Incident directions per point in training."""
    eval_samples: int = 256
    """Incident directions per point in evaluation."""
    hit_share: float = 0.8
    """Least concentration of a ray's blending weight at a surface point; other hits are not shaded."""


@dataclass(frozen=True)
class InterReflectionConfig:
    """L_ref: what arrives from another surface is what that surface sends (METHOD §2)."""

    mode: Literal["off", "soft", "hard"] = "soft"
    """soft: the paper's loss. hard: directions that meet the scene bring R from there; others the light."""
    rays_per_point: float = 1.0
    """Traced directions per surface point and step, in expectation."""
    radiance_gradient: float = 0.0
    """Scale of the gradient that reaches R; 0 detaches it, 0.7 suits fixed geometry."""
    offset: float = 0.02
    """Least displacement off the surface; it grows with β and as 1/cos towards grazing."""


# --------------------------------------------------------------------------------------------------- training


@dataclass(frozen=True)
class LossConfig:
    """Weights of the losses (METHOD §4) beside L_phys, which has 1; `schedule.py` says in which stage each
    counts. 0 switches a loss off.
    """

    unit: Literal["activation", "median"] = "activation"
    """What radiance is measured in. activation: L_vol in the range of R's output, all else absolute, as the
    paper has it. median: all in the median of the images, so that the weights depend neither on the exposure
    nor on what cameras store.
    """
    volume: float = 1.0
    eikonal: float = 0.1
    hessian: float = 1e-3
    hessian_growth: float = 1.0
    """Weight of L_Hess at the end of SDF init over its start: shapes fold early; late ripples are noise."""
    hessian_joint: float = 1e-4
    surface: float = 1e-3
    surface_joint: float = 1e-4
    point_cloud: float = 0.0
    inter_reflection: float = 0.1
    smoothness: float = 5e-4
    lambertian: float = 5e-4
    mask: float = 0.0
    """Opacity against the object mask, where the capture has masks or shows exactly its background."""
    points: Literal["scene", "rays"] = "rays"
    """Where L_Eik, L_Hess and L_surf look. scene: at points all over the scene, more of them about the
    object, and L_Eik at one sample of each ray as well; L_surf is so wide then that it hardly has a slope
    (published code). rays: at the samples of the rays, and L_Hess about their hits.
    """
    position_gradient: float = 0.1
    """Scale of the gradient from the material into the hit position, joint stage."""
    normal_gradient: float = 1.0
    """Scale of the gradient from the material into the hit normal, joint stage."""


@dataclass(frozen=True)
class OptimizerConfig:
    """Adam, one learning rate per field, which falls in the course of each stage."""

    geometry: float = 1e-3
    radiance: float = 1e-3
    brdf: float = 1e-3
    light: float = 1e-3
    background: float = 1e-3
    beta: float = 1e-3
    exposure: float = 0.0
    """Of log gains of photographs, where evidence calls for them; 0: all are taken to be exposed alike."""
    joint: float = 1.0
    """Factor on all rates in the joint stage."""
    final: tuple[float, float, float] = (0.1, 0.1, 0.1)
    """Rate at the end of each of the three stages over its start."""
    drops: tuple[int, int, int] = (0, 0, 0)
    """In how many equal steps, evenly spaced, the rate falls in each stage; 0: exponentially all along."""
    warm_up: int = 0
    """Steps at the start of each stage in which the rate rises from a tenth."""
    background_from: float = 0.0
    """Share of SDF init that is over when the field beyond the scene starts to move. Until then it is the
    colour that it starts as: a field that is seen from everywhere can paint the scene as well.
    """


@dataclass(frozen=True)
class TrainConfig:
    """The loop."""

    sdf_steps: int = 40_000
    """Steps of the stage SDF init."""
    material_steps: int = 20_000
    """Steps of the stage material init."""
    joint_steps: int = 20_000
    """Steps of the joint stage; 0 is the paper's separate pipeline ("Sep.")."""
    rays: int = 4096
    """Rays per step and process."""
    fresh: float = 1.0
    """Share of a step's rays rendered while the surface stands still; other points are replayed."""
    seed: int = 0
    """Every random number of step k follows from seed and k alone."""
    checkpoint_every: int = 500
    """Steps between checkpoints."""
    eval_chunk: int = 2048
    """Rays rendered at once in evaluation; bounds the memory."""


@dataclass(frozen=True)
class NeilfConfig:
    """Everything that decides a run, besides the capture."""

    preset: str = "custom"
    """The preset that the settings started from; a label."""
    host: HostConfig = field(default_factory=VolSdfConfig)
    encoding: EncodingConfig = field(default_factory=FrequencyConfig)
    radiance: OutgoingRadianceConfig = field(default_factory=OutgoingRadianceConfig)
    brdf: BrdfConfig = field(default_factory=BrdfConfig)
    light: IncidentLightConfig = field(default_factory=FreeLightConfig)
    background: BackgroundConfig = field(default_factory=BackgroundConfig)
    volume: VolumeConfig = field(default_factory=VolumeConfig)
    shading: ShadingConfig = field(default_factory=ShadingConfig)
    inter_reflection: InterReflectionConfig = field(default_factory=InterReflectionConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    optimizer: OptimizerConfig = field(default_factory=OptimizerConfig)
    train: TrainConfig = field(default_factory=TrainConfig)

    @property
    def known_map(self) -> str | None:
        """The environment map that is given; none: the light is recovered."""
        return self.light.map if isinstance(self.light, MapLightConfig) else None
