"""The plan of effects of a training with `ns-train`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from neilfpp_method.effects.catalogue import EFFECTS
from neilfpp_method.effects.plan import Decision, Plan
from neilfpp_method.effects.request import check_effects, parse_effects
from neilfpp_method.errors import UserError
from neilfpp_method.settings.types import NeilfConfig

__all__ = ["begin_plan", "restore_decisions", "stored_decisions"]

OPTION = "--pipeline.model.effects"


def begin_plan(effects: str, settings: NeilfConfig) -> Plan:
    """A plan with the decisions that need no measurement.

    Poses are not corrected: nerfstudio draws the rays, and has a camera optimizer of its own.

    Args:
        effects: the value of `--pipeline.model.effects`, as `neilfpp train --effects` takes it.
        settings: the settings of the method.

    Raises:
        UserError: if an effect is unknown, or cannot be switched with these settings or in nerfstudio.
    """
    request = parse_effects(effects)
    check_effects(request, settings)
    if request.named.get("poses"):
        raise UserError(
            f"{OPTION} +poses: poses are not corrected in nerfstudio",
            "leave poses out, and use nerfstudio's camera optimizer or `neilfpp train`",
        )
    plan = Plan.begin(request, settings)
    if plan.is_on("poses") and not EFFECTS["poses"].obstacle(settings):
        reason = "not measured: nerfstudio has a camera optimizer of its own"
        plan.decisions.append(Decision(0, "poses", False, "files", reason))
    return plan


def stored_decisions(plan: Plan) -> dict[str, Any]:
    """The request and the decisions of a plan, as plain values for checkpoints."""
    return {"request": str(plan.request), "decisions": plan.stored()}


def restore_decisions(plan: Plan, stored: Mapping[str, Any]) -> None:
    """Replace the decisions of a plan by those that `stored_decisions` returned.

    Raises:
        UserError: if they answer another request, for which the model was built differently.
    """
    if stored["request"] != str(plan.request):
        raise UserError(
            f"{OPTION} is '{plan.request}', but the checkpoint was trained with '{stored['request']}'",
            f"continue with {OPTION} {stored['request']}, or start a new run",
        )
    plan.restore(stored["decisions"], "checkpoint")
