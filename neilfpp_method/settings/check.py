"""Settings that contradict each other or cannot be built: refused in one line before the start."""

from __future__ import annotations

from neilfpp_method.errors import UserError
from neilfpp_method.settings.types import InterReflectionConfig, NeilfConfig

__all__ = ["check_config"]


def check_config(config: NeilfConfig) -> None:
    """Refuse what no model can be made of, whoever trains it.

    Raises:
        UserError: a share or a rate that is none, or two settings that exclude each other.
    """
    if not 0 < config.train.fresh <= 1:
        raise UserError(f"--config.train.fresh is {config.train.fresh}", "set it above 0 and to 1 at most")
    rates = config.optimizer
    if min(rates.final) <= 0 or min(rates.drops) < 0 or rates.warm_up < 0:
        raise UserError(
            f"--config.optimizer.final {rates.final}, drops {rates.drops}, warm-up {rates.warm_up}",
            "set each of final above 0, the others to 0 at least",
        )
    _check_scene(config.inter_reflection, config.light.kind)


def _check_scene(settings: InterReflectionConfig, light: str) -> None:
    if settings.mode == "soft" and light != "free":
        raise UserError(
            f"soft inter-reflection with the light '{light}', which L_ref cannot teach",
            "set --config.inter-reflection.mode hard, or --config.light.kind free",
        )
