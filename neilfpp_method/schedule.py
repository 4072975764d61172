"""The three training stages and their losses as data (METHOD §4, Table 1 of the paper).

    stage          L_ref L_vol L_Eik L_Hess L_surf L_pcd L_phys L_smth L_Lam | trains
    SDF init         -     x     x     x      x     (x)    -      -      -   | G, R
    material init    x     -     -     -      -      -     x      x      x   | B, L
    joint            x     x     x     low    low    -     x      x      x   | G, R, B, L

"low" means a lower weight than in SDF init. Presets made for photographs add L_patch in SDF init. If
photographs have gains of their own, the prior on the gains is active whenever L_vol is.

Two more tables are for hosts whose geometry is not trained here. With given geometry (`FIXED_GEOMETRY`), R is
a surface light field and is trained together with the material. For a host that belongs to another trainer
(`BORROWED_HOST`), that trainer is responsible for the first stage.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum

from jaxtyping import Float
from torch import Tensor

from neilfpp_method.settings.types import (
    GeometryLossConfig,
    NeilfConfig,
    OptimizerConfig,
    TrainConfig,
    VolumeConfig,
)
from neilfpp_method.structures import LossTerms

__all__ = [
    "BORROWED_HOST",
    "FIXED_GEOMETRY",
    "STAGES",
    "Stage",
    "StagePlan",
    "StagePosition",
    "StageTable",
    "Total",
    "active_losses",
    "learning_rate",
    "rate_factor",
    "stage_at",
    "stage_steps",
    "surface_width_limit",
    "total_steps",
    "weigh",
]


class Stage(str, Enum):
    """The stages, in order."""

    SDF_INIT = "sdf_init"
    MATERIAL_INIT = "material_init"
    JOINT = "joint"


LIGHT_FIELD = frozenset({"radiance", "background", "exposure"})
GEOMETRY = LIGHT_FIELD | {"geometry", "beta"}
MATERIAL = frozenset({"brdf", "light"})

EXPOSURE_PRIOR = 0.1
"""Weight of the prior that keeps the log gains of photographs near their initial values. Without it they are
nearly undetermined: R, which depends on the direction, can compensate a gain that all pixels of a view share.
"""

INTER_REFLECTION = 0.1
"""Weight of L_ref in the material stages, relative to L_phys, whose weight is 1 (published code)."""

TILT_PRIOR = 1.0
"""Weight of the prior on tilts of normals: a tilt of 3° costs as much as an error of 0.003 in L_phys. Hosts
that do not smooth their normals have no tilts, and this loss is not computed for them.
"""

MATERIAL_LOSSES = {name: name for name in ("smoothness", "lambertian")}
"""Priors of the material stages, with the settings that hold their weights."""


@dataclass(frozen=True)
class StagePlan:
    """One row of a stage table.

    Attributes:
        weights: for each loss of every host whose weight is a setting, the name of that setting in
            `LossConfig`. The weights of the other losses are fixed (`active_losses`).
        trains: parameter groups that the stage trains.
        geometry_losses: the losses that only train G, whose weights are in `GeometryLossConfig`.
    """

    weights: Mapping[str, str]
    trains: frozenset[str]
    geometry_losses: tuple[str, ...] = ()

    @property
    def trains_host(self) -> bool:
        """Whether any parameter of the host is trained."""
        return bool(self.trains & GEOMETRY)

    @property
    def trains_material(self) -> bool:
        """Whether material and light are trained."""
        return bool(self.trains & MATERIAL)


StageTable = Mapping[Stage, StagePlan]

STAGES: StageTable = {
    Stage.SDF_INIT: StagePlan(
        weights={"volume": "volume"},
        trains=GEOMETRY,
        geometry_losses=("mask", "eikonal", "hessian", "surface", "point_cloud", "patches"),
    ),
    Stage.MATERIAL_INIT: StagePlan(weights=MATERIAL_LOSSES, trains=MATERIAL),
    Stage.JOINT: StagePlan(
        weights={"volume": "volume", **MATERIAL_LOSSES},
        trains=GEOMETRY | MATERIAL,
        geometry_losses=("mask", "eikonal", "hessian", "surface"),
    ),
}

RADIANCE_AND_MATERIAL = StagePlan({"volume": "volume", **MATERIAL_LOSSES}, LIGHT_FIELD | MATERIAL)

# For given geometry (a mesh). The optional first stage trains only R.
FIXED_GEOMETRY: StageTable = {
    Stage.SDF_INIT: StagePlan({"volume": "volume"}, LIGHT_FIELD),
    Stage.MATERIAL_INIT: RADIANCE_AND_MATERIAL,
    Stage.JOINT: RADIANCE_AND_MATERIAL,
}

# For a host that another trainer owns. The first stage has no loss, so nothing is computed in it.
BORROWED_HOST: StageTable = {
    Stage.SDF_INIT: StagePlan({}, frozenset()),
    Stage.MATERIAL_INIT: STAGES[Stage.MATERIAL_INIT],
    Stage.JOINT: StagePlan({"volume": "volume", **MATERIAL_LOSSES}, GEOMETRY | MATERIAL),
}


def stage_steps(config: TrainConfig) -> Mapping[Stage, int]:
    """Number of steps of each stage, in order."""
    return {
        Stage.SDF_INIT: config.sdf_steps,
        Stage.MATERIAL_INIT: config.material_steps,
        Stage.JOINT: config.joint_steps,
    }


def total_steps(config: TrainConfig) -> int:
    """Number of steps of all stages together."""
    return sum(stage_steps(config).values())


def has_material(steps: int, config: TrainConfig) -> bool:
    """Whether material and light have been trained after `steps` steps."""
    return steps > config.sdf_steps


@dataclass(frozen=True)
class StagePosition:
    """Position of a global step: its stage, its index within the stage, and the stage's number of steps."""

    stage: Stage
    step: int
    length: int

    @property
    def share(self) -> float:
        """Share of the stage that is completed, in [0, 1]."""
        return self.step / self.length


def stage_at(step: int, config: TrainConfig) -> StagePosition:
    """Position of a global step, counted from 0. After training it is the end of the last stage."""
    start = 0
    lengths = [(stage, n) for stage, n in stage_steps(config).items() if n > 0]
    for stage, length in lengths:
        if step < start + length:
            return StagePosition(stage, step - start, length)
        start += length
    stage, length = lengths[-1]
    return StagePosition(stage, length, length)


WARM_UP_START = 0.1
"""Ratio of the learning rate at the first step of a warm-up to the rate after it (published code)."""


def rate_factor(config: OptimizerConfig, position: StagePosition) -> float:
    """Factor on the learning rates at a step: warm-up times decay times the factor of the joint stage.

    The decay is exponential, from 1 to `config.final` at the end of the stage: continuous if `config.drops`
    is 0 for the stage, else in that many equal drops.

    Example:
        >>> halfway = StagePosition(Stage.SDF_INIT, step=50, length=100)
        >>> rate_factor(OptimizerConfig(final=(0.01, 1.0, 1.0)), halfway)
        0.1
        >>> rate_factor(OptimizerConfig(final=(0.01, 1.0, 1.0), drops=(1, 0, 0)), halfway)
        0.01
    """
    index = list(Stage).index(position.stage)
    final, drops = config.final[index], config.drops[index]
    if drops:
        decayed = min(position.step * (drops + 1) // position.length, drops) / drops
    else:
        decayed = position.share
    warm_up = WARM_UP_START ** max(0.0, 1.0 - position.step / config.warm_up) if config.warm_up else 1.0
    return (config.joint if position.stage is Stage.JOINT else 1.0) * warm_up * final**decayed


def surface_width_limit(config: VolumeConfig, position: StagePosition) -> float:
    """The largest β after a step, scene units: it falls from `beta_init` to `beta_final` in SDF init.

    Photographs that the radiance field cannot explain sharply are explained best by fog, and a β that is
    only learned then stays large. BakedSDF (Yariv et al. 2023) prescribes β; here it is bounded, so a
    surface may become sharp earlier.

    Example:
        >>> halfway = StagePosition(Stage.SDF_INIT, step=50, length=100)
        >>> round(surface_width_limit(VolumeConfig(beta_init=0.04, beta_final=0.01), halfway), 6)
        0.02
    """
    if config.beta_final == 0.0 or position.stage is Stage.MATERIAL_INIT:
        # Geometry is not trained in material init.
        return math.inf
    share = position.share if position.stage is Stage.SDF_INIT else 1.0
    first = max(config.beta_init, config.beta_final)
    return first * (config.beta_final / first) ** share


def learning_rate(config: OptimizerConfig, field: str) -> float:
    """Learning rate of a field before warm-up and decay.

    The background learns at the rate of R. A field with another name, as a host of another project may have
    one, learns at the rate of the geometry.
    """
    if field == "background":
        return config.radiance
    return getattr(config, field) if field in GEOMETRY | MATERIAL else config.geometry


def active_losses(
    stage: Stage, config: NeilfConfig, stages: StageTable = STAGES, share: float = 0.0
) -> Mapping[str, float]:
    """The active losses of a stage with their weights.

    A loss with weight 0, or of an effect that is switched off, is absent and is never computed. So are the
    losses of G if the settings say that geometry is given.

    Args:
        stage: the stage of training.
        config: the settings.
        stages: the stage table of the host.
        share: share of the stage that is completed, in [0, 1].
    """
    plan = stages[stage]
    weights = {loss: getattr(config.loss, setting) for loss, setting in plan.weights.items()}
    if config.geometry_loss is not None:
        changing = _changing_weights(stage, config.geometry_loss, share)
        weights |= {
            loss: changing[loss] if loss in changing else getattr(config.geometry_loss, loss)
            for loss in plan.geometry_losses
        }
    if plan.trains_material:
        weights["physical"] = 1.0
        if config.light.inter_reflection == "soft":
            weights["inter_reflection"] = INTER_REFLECTION
        if config.shading.normals == "refined":
            weights["tilt"] = TILT_PRIOR
    if config.optimizer.exposure > 0 and "volume" in weights:
        weights["exposure"] = EXPOSURE_PRIOR
    if not config.shading.specular:
        # A Lambertian surface has neither roughness nor metallic, on which these losses act.
        for loss in ("smoothness", "lambertian"):
            weights.pop(loss, None)
    if not (config.brdf.varying_roughness or config.brdf.metals):
        # Neither roughness nor metallic varies in space: their gradients are 0.
        weights.pop("smoothness", None)
    return {loss: weight for loss, weight in weights.items() if weight > 0}


def _changing_weights(stage: Stage, settings: GeometryLossConfig, share: float) -> dict[str, float]:
    """Weights of the losses of G that depend on the stage, after a share of it."""
    start, end, in_joint = settings.hessian
    if stage is Stage.JOINT:
        return {"hessian": in_joint, "surface": settings.surface[1]}
    return {"hessian": start ** (1.0 - share) * end**share, "surface": settings.surface[0]}


@dataclass(frozen=True)
class Total:
    """The weighted sum that is minimised, and each term reduced but unweighted, for the log."""

    loss: Float[Tensor, ""]
    terms: Mapping[str, Float[Tensor, ""]]


def weigh(terms: LossTerms, weights: Mapping[str, float]) -> Total:
    """Reduce each term to its mean and sum them with their weights.

    Raises:
        KeyError: a term has no weight: it is not active in this stage and must not be computed.
    """
    reduced = {name: term.mean() for name, term in terms.items()}
    total = sum(weights[name] * value for name, value in reduced.items())
    return Total(total, {name: value.detach() for name, value in reduced.items()})
