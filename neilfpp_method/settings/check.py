"""Check a configuration before training: values out of range, and settings that exclude each other."""

from __future__ import annotations

from neilfpp_method.errors import UserError
from neilfpp_method.settings.types import InterReflectionConfig, NeilfConfig

__all__ = ["check_config"]


def check_config(config: NeilfConfig) -> None:
    """Reject settings from which no model can be made, in every training loop.

    Raises:
        UserError: a share or a rate is out of range, or two settings exclude each other.
    """
    if not 0 < config.train.fresh <= 1:
        raise UserError(f"--config.train.fresh is {config.train.fresh}", "set it above 0 and at most to 1")
    if config.volume.beta_final < 0:
        raise UserError(
            f"--config.volume.beta-final is {config.volume.beta_final}", "set it to 0 (no bound) or more"
        )
    rates = config.optimizer
    if min(rates.final) <= 0 or min(rates.drops) < 0 or rates.warm_up < 0:
        raise UserError(
            f"--config.optimizer.final {rates.final}, drops {rates.drops}, warm-up {rates.warm_up}",
            "set every value of final above 0, and the others to 0 or more",
        )
    _check_inter_reflection(config.inter_reflection, config.light.kind)


def _check_inter_reflection(settings: InterReflectionConfig, light: str) -> None:
    if settings.mode == "soft" and light != "free":
        raise UserError(
            f"soft inter-reflection with the light '{light}', which the loss L_ref cannot train",
            "set --config.inter-reflection.mode hard, or --config.light.kind free",
        )
