"""The three stages and the loss table (METHOD §4, Table 1 of the paper), as data.

    stage          L_ref L_vol L_Eik L_Hess L_surf L_pcd L_phys L_smth L_Lam | moves
    SDF init         -     x     x     x      x     (x)    -      -      -   | G, R
    material init    x     -     -     -      -      -     x      x      x   | B, L
    joint            x     x     x     low    low    -     x      x      x   | G, R, B, L

Where photographs have gains of their own, their prior goes with L_vol.

Two more tables are for hosts whose geometry is not ours to train: where it is given, R is a surface light
field and moves with the material; where the host belongs to another trainer, that one sees to the first
stage.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum

from jaxtyping import Float
from torch import Tensor

from neilfpp_method.settings.types import NeilfConfig, OptimizerConfig, TrainConfig
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
    "rate_factor",
    "stage_at",
    "stage_steps",
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
"""Weight of the squares of how far log gains come from their start: the same gain in all pixels of a view is
otherwise nearly free, as what it sends into each direction is learned as well.
"""

# Losses of the material stages and the settings that weigh them, relative to L_phys at 1.
MATERIAL_LOSSES = {name: name for name in ("inter_reflection", "smoothness", "lambertian")}


@dataclass(frozen=True)
class StagePlan:
    """One row of the table: for each loss that counts the setting that weighs it, and the fields that move;
    for each loss whose weight grows in the course of the stage the setting that says by how much.
    """

    weights: Mapping[str, str]
    moves: frozenset[str]
    grows: Mapping[str, str] = field(default_factory=dict)

    @property
    def moves_host(self) -> bool:
        return bool(self.moves & GEOMETRY)

    @property
    def moves_material(self) -> bool:
        return bool(self.moves & MATERIAL)


StageTable = Mapping[Stage, StagePlan]

STAGES: StageTable = {
    Stage.SDF_INIT: StagePlan(
        weights={
            "volume": "volume",
            "mask": "mask",
            "eikonal": "eikonal",
            "hessian": "hessian",
            "surface": "surface",
            "point_cloud": "point_cloud",
        },
        moves=GEOMETRY,
        grows={"hessian": "hessian_growth"},
    ),
    Stage.MATERIAL_INIT: StagePlan(weights=MATERIAL_LOSSES, moves=MATERIAL),
    Stage.JOINT: StagePlan(
        weights={
            "volume": "volume",
            "mask": "mask",
            "eikonal": "eikonal",
            "hessian": "hessian_joint",
            "surface": "surface_joint",
            **MATERIAL_LOSSES,
        },
        moves=GEOMETRY | MATERIAL,
    ),
}

TOGETHER = StagePlan({"volume": "volume", **MATERIAL_LOSSES}, LIGHT_FIELD | MATERIAL)

# Geometry is given (a mesh). The first stage, where somebody wants it, is R alone.
FIXED_GEOMETRY: StageTable = {
    Stage.SDF_INIT: StagePlan({"volume": "volume"}, LIGHT_FIELD),
    Stage.MATERIAL_INIT: TOGETHER,
    Stage.JOINT: TOGETHER,
}

# Another trainer owns the host. Before there is a material nothing is computed: it costs nothing.
BORROWED_HOST: StageTable = {
    Stage.SDF_INIT: StagePlan({}, frozenset()),
    Stage.MATERIAL_INIT: STAGES[Stage.MATERIAL_INIT],
    Stage.JOINT: StagePlan({"volume": "volume", **MATERIAL_LOSSES}, GEOMETRY | MATERIAL),
}


def stage_steps(config: TrainConfig) -> Mapping[Stage, int]:
    """Steps of each stage, in order."""
    return {
        Stage.SDF_INIT: config.sdf_steps,
        Stage.MATERIAL_INIT: config.material_steps,
        Stage.JOINT: config.joint_steps,
    }


def total_steps(config: TrainConfig) -> int:
    """Of all stages together."""
    return sum(stage_steps(config).values())


def has_material(steps: int, config: TrainConfig) -> bool:
    """Whether the first `steps` steps moved material and light, which keep their start before that."""
    return steps > config.sdf_steps


@dataclass(frozen=True)
class StagePosition:
    """Where a global step lies: its stage, its number within the stage, and the stage's length."""

    stage: Stage
    step: int
    length: int

    @property
    def share(self) -> float:
        """Of the stage, what is over."""
        return self.step / self.length


def stage_at(step: int, config: TrainConfig) -> StagePosition:
    """The stage of a global step (from 0); one past the end of the last stage when training is over."""
    start = 0
    lengths = [(stage, n) for stage, n in stage_steps(config).items() if n > 0]
    for stage, length in lengths:
        if step < start + length:
            return StagePosition(stage, step - start, length)
        start += length
    stage, length = lengths[-1]
    return StagePosition(stage, length, length)


WARM_UP_START = 0.1
"""Rate at the first step of a warm-up over the rate that it rises to (published code)."""


def rate_factor(config: OptimizerConfig, position: StagePosition) -> float:
    """The factor on a learning rate at a step of a stage: the stage's own, its decay and its warm-up.

    Example:
        >>> halfway = StagePosition(Stage.SDF_INIT, step=50, length=100)
        >>> rate_factor(OptimizerConfig(final=(0.01, 1.0, 1.0)), halfway)
        0.1
        >>> rate_factor(OptimizerConfig(final=(0.01, 1.0, 1.0), drops=(1, 0, 0)), halfway)  # at once
        0.01
    """
    stage = list(Stage).index(position.stage)
    final, drops = config.final[stage], config.drops[stage]
    fallen = min(position.step * (drops + 1) // position.length, drops) / drops if drops else position.share
    start = WARM_UP_START ** max(0.0, 1.0 - position.step / config.warm_up) if config.warm_up else 1.0
    return (config.joint if position.stage is Stage.JOINT else 1.0) * start * final**fallen


def active_losses(
    stage: Stage, config: NeilfConfig, stages: StageTable = STAGES, share: float = 0.0
) -> Mapping[str, float]:
    """The losses that count in a stage, with their weights when `share` of it is over.

    One of weight 0, or whose effect is switched off, is absent: nothing computes it.
    """
    plan = stages[stage]
    weights = {loss: getattr(config.loss, setting) for loss, setting in plan.weights.items()}
    weights |= {
        loss: weights[loss] * getattr(config.loss, setting) ** share for loss, setting in plan.grows.items()
    }
    if plan.moves_material:
        weights["physical"] = 1.0
    if config.optimizer.exposure > 0 and "volume" in weights:
        weights["exposure"] = EXPOSURE_PRIOR
    if config.inter_reflection.mode != "soft":
        weights.pop("inter_reflection", None)
    if not config.shading.specular:
        # A Lambertian surface has neither roughness nor metallic, and sends what it gets times its colour.
        for loss in ("smoothness", "lambertian"):
            weights.pop(loss, None)
    if not (config.brdf.varying_roughness or config.brdf.metals):
        weights.pop("smoothness", None)  # There is nothing whose slope it could lower.
    return {loss: weight for loss, weight in weights.items() if weight > 0}


@dataclass(frozen=True)
class Total:
    """The weighted sum that is minimised, and each reduced term before its weight, for the log."""

    loss: Float[Tensor, ""]
    terms: Mapping[str, Float[Tensor, ""]]


def weigh(terms: LossTerms, weights: Mapping[str, float]) -> Total:
    """Reduce the terms and add them up.

    Raises:
        KeyError: a term has no weight: somebody computed a loss that does not count in this stage.
    """
    reduced = {name: term.mean() for name, term in terms.items()}
    total = sum(weights[name] * value for name, value in reduced.items())
    return Total(total, {name: value.detach() for name, value in reduced.items()})
