"""What is decided of the effects of a run, one decision after the other, and the settings that follow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

from neilfpp_method.effects.asked import Asked
from neilfpp_method.effects.catalogue import EFFECTS, switched
from neilfpp_method.effects.measurement import Measurement
from neilfpp_method.settings.types import NeilfConfig

__all__ = ["Decision", "Plan", "decided_settings"]

By = Literal["asked", "settings", "files", "evidence"]


@dataclass(frozen=True)
class Decision:
    """Whether an effect is simulated from a step on.

    Attributes:
        step: of the training; 0: from the start.
        effect: by name, as in `EFFECTS`.
        on: whether it is simulated.
        by: who decided: a person by --effects, the settings, the files of the capture before training, or
            evidence of the model that trains.
        reason: for people, a clause.
        evidence: what was measured; none where nothing was.
    """

    step: int
    effect: str
    on: bool
    by: By
    reason: str
    evidence: Measurement | None = None

    @property
    def before_training(self) -> bool:
        """Whether the model is built after it."""
        return self.by != "evidence"


def decided_settings(settings: NeilfConfig, decisions: Sequence[Decision]) -> NeilfConfig:
    """The settings with the newest decision on each effect.

    Requested effects are set as asked. Evidence only removes: a kept effect is as the settings have it.
    """
    newest = {decision.effect: decision for decision in decisions}
    for name, decision in newest.items():
        if decision.by == "settings" or (decision.by == "evidence" and EFFECTS[name].solved):
            continue
        if not decision.on:
            settings = switched(settings, EFFECTS[name], on=False)
        elif decision.by == "asked":
            settings = switched(settings, EFFECTS[name], on=True)
    return settings


@dataclass
class Plan:
    """The effects of a run.

    Attributes:
        asked: what a person asked for.
        settings: those of the run before any decision.
        decisions: in the order in which they were taken; the newest on each effect counts.
    """

    asked: Asked
    settings: NeilfConfig
    decisions: list[Decision] = field(default_factory=list)

    @staticmethod
    def begin(asked: Asked, settings: NeilfConfig) -> Plan:
        """A plan with what is decided before anything is looked at."""
        plan = Plan(asked, settings)
        for name, effect in EFFECTS.items():
            obstacle = effect.obstacle(settings)
            if name in asked.named:
                plan.decisions.append(Decision(0, name, asked.named[name], "asked", "asked for by name"))
            elif obstacle:
                plan.decisions.append(Decision(0, name, effect.is_on(settings), "settings", obstacle))
            elif asked.base in ("all", "none"):
                plan.decisions.append(
                    Decision(0, name, asked.base == "all", "asked", f"--effects {asked.base}")
                )
            elif asked.base == "as-set":
                plan.decisions.append(
                    Decision(0, name, effect.is_on(settings), "settings", "as the settings say")
                )
            elif not effect.is_on(settings):
                plan.decisions.append(Decision(0, name, False, "settings", "off in the settings"))
            elif effect.unjudged(settings):
                plan.decisions.append(Decision(0, name, True, "settings", effect.unjudged(settings)))
        plan._leave_out_what_needs_others()
        return plan

    @property
    def config(self) -> NeilfConfig:
        """The settings that the run goes on with."""
        return decided_settings(self.settings, self.decisions)

    @property
    def config_of_model(self) -> NeilfConfig:
        """The settings that the model of the run is built from: evidence of a model changes what is computed
        with it, and none of its tensors.
        """
        return decided_settings(self.settings, [d for d in self.decisions if d.before_training])

    def newest(self, name: str) -> Decision | None:
        """What was decided last of an effect; none: nothing yet."""
        return next((d for d in reversed(self.decisions) if d.effect == name), None)

    def is_on(self, name: str) -> bool:
        """Whether an effect is simulated, or still open."""
        newest = self.newest(name)
        return newest.on if newest else EFFECTS[name].is_on(self.settings)

    def is_open(self, name: str) -> bool:
        """Whether evidence of the model may decide an effect."""
        newest = self.newest(name)
        return newest is None or newest.by == "evidence"

    def _leave_out_what_needs_others(self) -> None:
        """Decide against what there is none of without an effect that is off."""
        for name, effect in EFFECTS.items():
            cause = self.newest(effect.needs) if effect.needs else None
            if cause is None or cause.on or not self.is_on(name) or effect.obstacle(self.settings):
                continue
            why = f"there is none without {effect.needs}"
            self.decisions.append(Decision(0, name, False, cause.by, why))

    def decide(self, name: str, measured: Measurement, step: int, must_be_earned: bool = False) -> Decision:
        """Decide an open effect by evidence, from now on; without enough samples it stays as it is.

        Where evidence only advises (`Effect.advised`), it is noted, and the effect stays as it is.
        `must_be_earned`: it counts as off so far, whatever the settings say.
        """
        before = self.is_on(name)
        favoured = measured.favours(before and not must_be_earned)
        advised = EFFECTS[name].advised
        on = before if favoured is None or advised else favoured
        reason = f"{measured.in_words()}; advice, it stays as it is" if advised else measured.in_words()
        if favoured is None:
            reason = f"{measured.samples} samples are too few to say anything of {measured.what}"
        elif self.newest(name) is not None and on != before:
            reason = f"revised: {reason}"
        decision = Decision(step, name, on, "evidence", reason, measured)
        self.decisions.append(decision)
        return decision
