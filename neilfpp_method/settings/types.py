"""All settings as dataclasses, one per part of the method. `settings.presets` has named sets of values.

Lengths are in scene units (the object lies in the unit sphere). A setting named `kind` or `mode`, or of type
`bool`, is a switch: an effect that is switched off evaluates no network and traces no ray. The docstrings of
the settings are the texts of `neilfpp train --help-all`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

import tyro

__all__ = ["NeilfConfig"]

SOFT_OFFSET = 0.02
"""Height above a volume-rendered surface at which secondary rays start, scene units, before its width is
added.
"""
MESH_OFFSET = 2e-3
"""The same for a mesh, which has no soft layer; a ray that started on a triangle could hit it by rounding."""


# ----------------------------------------------------------------------------------------------------- fields


@dataclass(frozen=True)
class FrequencyConfig:
    """Frequency encoding of positions in six octaves (the paper's MLP setting); B then has sine layers."""

    kind: Literal["frequency"] = "frequency"
    """Encoding of positions for G, R and B: frequency or hash."""


@dataclass(frozen=True)
class HashGridConfig:
    """Multiresolution hash grids for positions, one each for G, B and, if encoded, R (Müller et al. 2022)."""

    kind: Literal["hash"] = "hash"
    """Encoding of positions for G, R and B: frequency or hash."""
    levels: int = 16
    """Number of levels of a hash grid, from coarse to fine."""
    log2_entries: int = 19
    """Binary logarithm of the table size of one level, for B and R."""
    sdf_log2_entries: int = 19
    """Binary logarithm of the table size of one level, for G. A table without collisions costs no more."""
    max_resolution: int = 4096
    """Cells along an edge of the scene's cube at the finest level; the coarsest level has 16."""


EncodingConfig = Annotated[FrequencyConfig | HashGridConfig, tyro.conf.AvoidSubcommands]


@dataclass(frozen=True)
class SdfConfig:
    """Network of G: position → signed distance and a feature vector for R (METHOD §5)."""

    layers: int = 8
    """Number of hidden layers."""
    width: int = 256
    """Units per hidden layer."""
    feature_width: int = 256
    """Length of the feature vector that R gets."""
    start: Literal["sphere", "hull"] = "sphere"
    """Initial shape: a sphere; or the visual hull of the object masks, or without masks the hull of the point
    cloud."""


@dataclass(frozen=True)
class OutgoingRadianceConfig:
    """Network of R: position, direction, normal and feature of G → linear RGB (METHOD §5)."""

    positions: Literal["raw", "encoded"] = "raw"
    """raw: R gets the plain position, and detail comes from the feature of G. encoded: R has an encoding of
    its own, of the kind that `encoding` names; a host without features (a mesh) always uses it.
    """
    direction: Literal["outgoing", "mirrored"] = "outgoing"
    """Direction that is encoded for R: the outgoing direction (the paper), or its mirror direction about the
    normal. The radiance of a shiny surface varies smoothly with the mirror direction, which makes its normals
    easier to recover (Verbin et al. 2022, "Ref-NeRF").
    """
    layers: int = 4
    """Number of hidden layers."""
    width: int = 256
    """Units per hidden layer."""


@dataclass(frozen=True)
class BrdfConfig:
    """Network of B: position → base colour, roughness, metallic (METHOD §5)."""

    initial_base_color: float = 0.5
    """Initial base colour. Images hardly separate its scale from the light's, so the mean stays near this."""
    initial_metallic: float = 0.5
    """Initial metallic. A high value makes the first estimate of the light too dark for other surfaces."""
    metals: bool = True
    """Whether surfaces may be metallic. If False, metallic is 0 everywhere."""
    varying_roughness: bool = True
    """Whether roughness varies in space. If False, the scene has a single roughness, which is learned."""
    layers: int = 8
    """Number of hidden layers."""
    width: int = 512
    """Units per hidden layer."""


@dataclass(frozen=True)
class LightFitConfig:
    """The fit of environment map and lamps to stored surface points (`lighting`)."""

    points: int = 1024
    """Surface points that the light is fitted to. Memory and time grow with points times texels."""
    every: int = 100
    """Training steps between two fits."""


@dataclass(frozen=True)
class MapLightConfig:
    """L as an environment map, optionally with lamps. L_ref cannot train it, so there is no "soft" mode."""

    kind: Literal["distant", "distant_near", "auto"] = "auto"
    """free: a light field that is free at every point (the paper). distant: an environment map. distant_near:
    an environment map and lamps near the scene. auto: an environment map, and lamps if they lower the error
    of points that are held back from the fit.
    """
    environment_height: int = 32
    """Rows of the environment map; it has twice as many columns. 1: the same radiance from all directions."""
    monochrome: bool = False
    """Whether the light has a single channel. Lamps are always coloured."""
    map: str | None = None
    """File of a known environment map (linear EXR, layout in docs/light.md). If not given, the map is
    recovered. Lamps are still recovered if `kind` allows them.
    """
    fit: LightFitConfig = field(default_factory=LightFitConfig)
    """How the map and the lamps are solved for."""
    inter_reflection: Literal["off", "hard"] = "hard"
    """Light that surfaces of the scene send to each other (METHOD §2). hard: incident directions that hit the
    scene bring R from there, and only the others bring the light. soft: the paper's loss L_ref. off: none.
    """


@dataclass(frozen=True)
class FreeLightConfig:
    """L as in the paper: a network of position and direction, sharp in direction and smooth in position."""

    kind: Literal["free"] = "free"
    """free: a light field that is free at every point (the paper). distant: an environment map. distant_near:
    an environment map and lamps near the scene. auto: an environment map, and lamps if they lower the error
    of points that are held back from the fit.
    """
    activation: Literal["sine", "relu"] = "sine"
    """Activation of the hidden layers; sine is that of SIREN with ω = 30."""
    layers: int = 8
    """Number of hidden layers; the position enters at the middle one."""
    width: int = 128
    """Units per hidden layer."""
    monochrome: bool = False
    """Whether the light has a single channel."""
    inter_reflection: Literal["off", "soft", "hard"] = "soft"
    """Light that surfaces of the scene send to each other (METHOD §2). hard: incident directions that hit the
    scene bring R from there, and only the others bring the light. soft: the paper's loss L_ref. off: none.
    """
    rays_per_point: float = 1.0
    """Expected number of traced rays per surface point and step, for L_ref."""


IncidentLightConfig = Annotated[FreeLightConfig | MapLightConfig, tyro.conf.AvoidSubcommands]


@dataclass(frozen=True)
class BackgroundConfig:
    """The scene sphere, and the radiance that rays get from beyond it."""

    radius: float = 3.0
    """Radius of the scene sphere, at which rays end and the background begins."""
    kind: Literal["auto", "none", "constant", "inverted_sphere"] = "auto"
    """none: R on the scene sphere, which closes the scene. constant: one colour. inverted_sphere: a NeRF++
    field. auto: constant if the image borders show a single colour behind the scene, else inverted_sphere.
    """
    color: tuple[float, float, float] | None = None
    """Linear RGB of a constant background, and initial colour of inverted_sphere. If not given, it is taken
    from the image borders.
    """
    samples: int = 32
    """Samples per ray beyond the scene sphere."""


# ------------------------------------------------------------------------------------------------------ hosts


@dataclass(frozen=True)
class VolumeConfig:
    """Volume rendering of G (METHOD §3)."""

    density: Literal["auto", "isotropic", "entering"] = "isotropic"
    """isotropic: that of VolSDF. entering: only where G falls along the ray, so rays that pass a surface by a
    few β are not opaque; needs a small `beta_init` (0.05). auto: entering if G starts as a hull.
    """
    beta_init: float = 0.1
    """Initial scale β of the Laplace density."""
    beta_final: float = 0.0
    """Upper bound of β from the end of SDF init on; until then it falls from `beta_init`. 0: no bound. Half
    of it applies where the density "auto" is isotropic.
    """
    skip_empty: bool = False
    """Whether rays skip parts that a coarse grid of the SDF shows to be empty, in training and evaluation.
    The sampler then queries the SDF less often, as the rest of a ray is short.
    """
    samples: int = 98
    """Rendered samples per ray: two thirds by opacity, the rest spread over the whole ray with both ends."""


@dataclass(frozen=True)
class GeometryLossConfig:
    """Weights of the losses that only train G (METHOD §4), relative to L_phys. 0 switches a loss off."""

    eikonal: float = 0.1
    """Weight of L_Eik: gradients of G have length 1."""
    hessian: tuple[float, float, float] = (1e-3, 1e-3, 1e-4)
    """Weights of L_Hess (little curvature of G): at the start and at the end of SDF init, and in the joint
    stage. A low weight at the start lets the shape form.
    """
    surface: tuple[float, float] = (1e-3, 1e-4)
    """Weights of L_surf (no unseen surfaces): in SDF init, and in the joint stage."""
    point_cloud: float = 0.0
    """Weight of L_pcd, the distance to an oriented point cloud, in SDF init."""
    patches: float = 0.0
    """Weight of L_patch in SDF init: patches of the surface look alike in all views that show them."""
    mask: float = 0.0
    """Weight of the loss of the opacity against the object mask, at pixels whose mask is known."""
    points: Literal["scene", "rays"] = "rays"
    """Points of L_Eik, L_Hess and L_surf. scene: random points in the whole scene, more of them around the
    object, and one sample per ray for L_Eik; L_surf is then so wide that its gradient is almost 0 (published
    code). rays: the samples of the rays, and points around their hits for L_Hess.
    """


@dataclass(frozen=True)
class VolSdfConfig:
    """Geometry is recovered: a signed distance field, rendered as a volume (`volume`)."""

    kind: Literal["volsdf"] = "volsdf"
    """Source of geometry: volsdf (recovered) or mesh (given)."""
    sdf: SdfConfig = field(default_factory=SdfConfig)
    volume: VolumeConfig = field(default_factory=VolumeConfig)
    loss: GeometryLossConfig = field(default_factory=GeometryLossConfig)


@dataclass(frozen=True)
class MeshConfig:
    """Geometry is given: a triangle mesh that is not changed."""

    kind: Literal["mesh"] = "mesh"
    """Source of geometry: volsdf (recovered) or mesh (given)."""
    path: str | None = None
    """File of the triangle mesh, in the world frame of the capture. If not given, inputs/model/mesh.ply of
    the capture. Normals are interpolated between vertices except across sharp edges.
    """


HostConfig = Annotated[VolSdfConfig | MeshConfig, tyro.conf.AvoidSubcommands]


# ---------------------------------------------------------------------------------------------------- shading


@dataclass(frozen=True)
class ShadingConfig:
    """The rendering equation (METHOD §1)."""

    lobe: Literal["spherical_gaussian", "ggx", "ggx_burley"] = "spherical_gaussian"
    """Microfacet distribution and masking function of the specular lobe. ggx_burley: GGX, and in place of
    Lambert's diffuse lobe that of Disney (Burley 2012), which depends on the roughness.
    """
    specular: bool = True
    """Whether surfaces reflect specularly. If False, they are Lambertian, without roughness and metallic."""
    normals: Literal["host", "refined"] = "host"
    """Normals for shading. host: as the geometry has them. refined: smoothed except across edges, and tilted
    by a coarse field that is learned with the material; only for hosts that can smooth their normals.
    """
    sampler: Literal["fibonacci", "cosine", "lobe", "mis", "no_lobe"] = "fibonacci"
    """Sampling of incident directions. fibonacci: the paper's lattice. cosine: by cosine. lobe: by the
    specular lobe. mis: by the light and the lobe, combined by the balance heuristic. no_lobe: by the light.
    The light is sampled if it is an environment map; otherwise cosine takes its place.
    """
    train_samples: int = 128
    """Incident directions per surface point in training; under a solved light, half for either estimate."""
    eval_samples: int = 256
    """Incident directions per surface point in evaluation."""
    hit_share: float = 0.8
    """A ray hits, and is shaded, if at least this share of its rendering weight lies close to one point."""


# --------------------------------------------------------------------------------------------------- training


@dataclass(frozen=True)
class LossConfig:
    """Weights of the losses of every host (METHOD §4), relative to L_phys, whose weight is 1. 0 switches a
    loss off.
    """

    unit: Literal["activation", "median"] = "activation"
    """Unit of radiance. activation (the paper): the range of R's output for L_vol, 1 for the other losses.
    median: the median radiance of the images, so that the balance of the losses depends neither on the
    exposure nor on the camera's response.
    """
    volume: float = 1.0
    """Weight of L_vol, the error of the volume-rendered colour."""
    smoothness: float = 5e-4
    """Weight of L_smth: roughness and metallic are smooth where the image is."""
    lambertian: float = 5e-4
    """Weight of L_Lam: roughness 1 and metallic 0 without evidence to the contrary."""
    position_gradient: float = 0.1
    """Factor on the gradient of L_phys into the hit position, in the joint stage."""
    normal_gradient: float = 1.0
    """Factor on the gradient of L_phys into the hit normal, in the joint stage."""


@dataclass(frozen=True)
class OptimizerConfig:
    """Learning rates of Adam, one per field, decayed over each stage."""

    geometry: float = 1e-3
    """Learning rate of G."""
    radiance: float = 1e-3
    """Learning rate of R and of the background field."""
    brdf: float = 1e-3
    """Learning rate of B."""
    light: float = 1e-3
    """Learning rate of L, if it is a network."""
    beta: float = 1e-3
    """Learning rate of the density's scale β."""
    exposure: float = 0.0
    """Learning rate of the log gains of the photographs. 0: all photographs have the same exposure."""
    joint: float = 1.0
    """Factor on all learning rates in the joint stage."""
    final: tuple[float, float, float] = (0.1, 0.1, 0.1)
    """Learning rate at the end of each of the three stages, relative to its start."""
    drops: tuple[int, int, int] = (0, 0, 0)
    """Number of equal, evenly spaced drops of the learning rate in each stage. 0: exponential decay."""
    warm_up: int = 0
    """Steps at the start of each stage in which the learning rate rises from a tenth."""
    background_from: float = 0.0
    """Share of SDF init after which the background field is trained. Before that it is a constant colour: a
    field that all views see could otherwise explain the object as well.
    """


@dataclass(frozen=True)
class TrainConfig:
    """The training loop."""

    sdf_steps: int = 40_000
    """Steps of the first stage, SDF init."""
    material_steps: int = 20_000
    """Steps of the second stage, material init."""
    joint_steps: int = 20_000
    """Steps of the joint stage. 0 is the paper's separate pipeline ("Sep.")."""
    pose_fits: int = 0
    """Times that camera poses are fitted to the photographs in SDF init. 0: poses are as given."""
    rays: int = 4096
    """Rays per step and process."""
    seed: int = 0
    """Seed. The random numbers of step k depend only on the seed and k."""
    checkpoint_every: int = 500
    """Steps between checkpoints."""


@dataclass(frozen=True)
class NeilfConfig:
    """All settings of a run. Together with the capture they determine its result."""

    preset: str = "custom"
    """Name of the preset that the settings were made from; a label."""
    host: HostConfig = field(default_factory=VolSdfConfig)
    encoding: EncodingConfig = field(default_factory=FrequencyConfig)
    radiance: OutgoingRadianceConfig = field(default_factory=OutgoingRadianceConfig)
    brdf: BrdfConfig = field(default_factory=BrdfConfig)
    light: IncidentLightConfig = field(default_factory=FreeLightConfig)
    background: BackgroundConfig = field(default_factory=BackgroundConfig)
    shading: ShadingConfig = field(default_factory=ShadingConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    optimizer: OptimizerConfig = field(default_factory=OptimizerConfig)
    train: TrainConfig = field(default_factory=TrainConfig)

    @property
    def known_map(self) -> str | None:
        """File of the given environment map; None if the light is recovered."""
        return self.light.map if isinstance(self.light, MapLightConfig) else None

    @property
    def geometry_loss(self) -> GeometryLossConfig | None:
        """Weights of the losses that train G; None if geometry is given."""
        return self.host.loss if isinstance(self.host, VolSdfConfig) else None

    @property
    def ray_offset(self) -> float:
        """Height above the surface at which rays to other surfaces start, scene units."""
        return MESH_OFFSET if isinstance(self.host, MeshConfig) else SOFT_OFFSET
