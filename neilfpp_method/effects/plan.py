"""The decisions on the effects of a run in order, and the settings that follow from them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

from neilfpp_method.effects.catalogue import EFFECTS, switched
from neilfpp_method.effects.measurement import Measurement
from neilfpp_method.effects.request import EffectRequest
from neilfpp_method.errors import UserError
from neilfpp_method.settings.plain import from_dict
from neilfpp_method.settings.types import NeilfConfig

__all__ = ["Decision", "Plan", "decided_settings", "stored_decision"]

By = Literal["option", "settings", "files", "evidence"]


@dataclass(frozen=True)
class Decision:
    """A decision whether an effect is simulated.

    Attributes:
        step: training step from which on the decision applies.
        effect: name of the effect, a key of `EFFECTS`.
        on: whether the effect is simulated.
        by: origin of the decision: the option `--effects` ("option"), the settings, the files of the capture
            before training, or evidence from the model in training.
        reason: explanation for the console and the report.
        evidence: the measurement; None if nothing was measured.
    """

    step: int
    effect: str
    on: bool
    by: By
    reason: str
    evidence: Measurement | None = None

    @property
    def before_training(self) -> bool:
        """Whether the decision was made before the model was built."""
        return self.by != "evidence"

    def summary(self) -> str:
        """One line for the console."""
        return f"effects: {self.effect} {'on' if self.on else 'off'}, {self.reason}"


def stored_decision(values: Mapping[str, Any], where: str) -> Decision:
    """Restore a decision from the plain values of `dataclasses.asdict`.

    Args:
        values: the values, of unknown origin.
        where: their origin, for error messages.

    Raises:
        UserError: the effect is unknown, or a value is missing or of another type.
    """
    try:
        evidence = values["evidence"]
        decision = from_dict(Decision, {key: v for key, v in values.items() if key != "evidence"}, where)
        if evidence is not None:
            decision = replace(decision, evidence=from_dict(Measurement, evidence, where))
    except (TypeError, AttributeError, KeyError) as error:
        # A key is missing, or a value is not an object.
        raise UserError(
            f"{where}: not a complete record ({error})", "restore the file or train again"
        ) from error
    if decision.effect not in EFFECTS:
        raise UserError(
            f"{where}: no effect '{decision.effect}'", "use the version of neilfpp that wrote the run"
        )
    return decision


def decided_settings(settings: NeilfConfig, decisions: Sequence[Decision]) -> NeilfConfig:
    """Apply the newest decision on each effect to settings.

    A decision by `--effects` can switch an effect on or off. Evidence only switches effects off, except those
    with `Effect.may_switch_on`: an effect that it keeps stays as it is in the settings.
    """
    newest = {decision.effect: decision for decision in decisions}
    for name, decision in newest.items():
        if decision.by == "settings" or (decision.by == "evidence" and EFFECTS[name].solved):
            continue
        if not decision.on:
            settings = switched(settings, EFFECTS[name], on=False)
        elif decision.by == "option" or EFFECTS[name].may_switch_on:
            settings = switched(settings, EFFECTS[name], on=True)
    return settings


@dataclass
class Plan:
    """The effects of a run.

    Attributes:
        request: the value of `--effects`.
        settings: the settings of the run before any decision.
        decisions: all decisions in order; the newest one on each effect applies.
    """

    request: EffectRequest
    settings: NeilfConfig
    decisions: list[Decision] = field(default_factory=list)

    @staticmethod
    def begin(request: EffectRequest, settings: NeilfConfig) -> Plan:
        """A plan with the decisions that need no measurement."""
        plan = Plan(request, settings)

        def decide(name: str, on: bool, by: By, reason: str) -> None:
            plan.decisions.append(Decision(0, name, on, by, reason))

        for name, effect in EFFECTS.items():
            obstacle, is_on = effect.obstacle(settings), effect.is_on(settings)
            if name in request.named:
                sign = "+" if request.named[name] else "-"
                decide(name, request.named[name], "option", f"--effects {sign}{name}")
            elif obstacle:
                decide(name, is_on, "settings", obstacle)
            elif request.base in ("all", "none"):
                decide(name, request.base == "all", "option", f"--effects {request.base}")
            elif request.base == "as-set":
                decide(name, is_on, "settings", f"{'on' if is_on else 'off'} in the settings")
            elif not is_on and not effect.may_switch_on:
                decide(name, False, "settings", "off in the settings")
            elif effect.not_measured(settings):
                decide(name, is_on, "settings", effect.not_measured(settings))
            elif effect.may_switch_on and is_on:
                decide(name, True, "settings", "on in the settings")
            elif effect.may_switch_on:
                decide(name, False, "evidence", "off until a half-trained model shows a gain")
        plan._leave_out_dependent_effects()
        return plan

    @property
    def config(self) -> NeilfConfig:
        """The settings with all decisions applied."""
        return decided_settings(self.settings, self.decisions)

    @property
    def config_of_model(self) -> NeilfConfig:
        """The settings from which the model is built.

        Only decisions from before training are applied. Later ones change what is computed with the model,
        but none of its parameters, so that checkpoints stay compatible.
        """
        return decided_settings(self.settings, [d for d in self.decisions if d.before_training])

    def stored(self) -> list[dict[str, Any]]:
        """The decisions as plain values, for checkpoints."""
        return [asdict(decision) for decision in self.decisions]

    def restore(self, stored: Sequence[Mapping[str, Any]], where: str) -> None:
        """Replace the decisions by those that `stored` returned; see `stored_decision`."""
        self.decisions[:] = [stored_decision(values, where) for values in stored]

    def newest(self, name: str) -> Decision | None:
        """The newest decision on an effect; None if there is none yet."""
        return next((d for d in reversed(self.decisions) if d.effect == name), None)

    def is_on(self, name: str) -> bool:
        """Whether an effect is simulated; for an open effect, whether the settings switch it on."""
        newest = self.newest(name)
        return newest.on if newest else EFFECTS[name].is_on(self.settings)

    def is_open(self, name: str) -> bool:
        """Whether evidence may decide an effect: nothing else has decided it."""
        newest = self.newest(name)
        return newest is None or newest.by == "evidence"

    def _leave_out_dependent_effects(self) -> None:
        """Switch off every effect that needs another effect which is off."""
        for name, effect in EFFECTS.items():
            cause = self.newest(effect.needs) if effect.needs else None
            if cause is None or cause.on or not self.is_on(name) or effect.obstacle(self.settings):
                continue
            reason = f"requires {effect.needs}, which is off"
            self.decisions.append(Decision(0, name, False, cause.by, reason))

    def decide(self, name: str, measured: Measurement, step: int) -> Decision:
        """Decide an open effect by evidence and record the decision.

        The effect stays as it is if there are too few samples, or if evidence only advises (see
        `Effect.advised`).

        Args:
            name: name of the effect.
            measured: the evidence.
            step: number of steps trained so far.
        """
        before = self.is_on(name)
        favoured = measured.favours(before and not EFFECTS[name].requires_gain)
        advised = EFFECTS[name].advised
        on = before if favoured is None or advised else favoured
        reason = f"{measured.summary()}; shown as advice only" if advised else measured.summary()
        if favoured is None:
            reason = f"not decided: only {measured.samples} samples of the {measured.what}"
        elif self.newest(name) is not None and on != before:
            reason = f"revised: {reason}"
        decision = Decision(step, name, on, "evidence", reason, measured)
        self.decisions.append(decision)
        return decision
