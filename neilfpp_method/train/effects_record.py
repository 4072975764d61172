"""The effects of a run, in `RUN/effects.json`: decisions and table; read by resumed and loaded runs.

format      1 asked       the value of --effects decisions   in order: step, effect, on, by, reason, evidence
(null, or what, value, deviation, threshold, samples) effects     a row per effect as `effects.table.rows` has
it, for whoever shows a run; it follows from the decisions
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from neilfpp_method.effects.asked import Asked, read_asked
from neilfpp_method.effects.catalogue import EFFECTS
from neilfpp_method.effects.measurement import Measurement
from neilfpp_method.effects.plan import Decision, Plan
from neilfpp_method.effects.table import rows
from neilfpp_method.errors import UserError
from neilfpp_method.settings.plain import from_dict
from neilfpp_method.settings.types import NeilfConfig
from neilfpp_method.train.json_files import read_json, write_json

__all__ = ["read_plan", "write_plan"]

FORMAT = 1
FILE = "effects.json"


def write_plan(run: Path, plan: Plan) -> None:
    """The decisions so far, and the table that they come to."""
    decisions = [dataclasses.asdict(decision) for decision in plan.decisions]
    write_json(
        run / FILE,
        {"format": FORMAT, "asked": str(plan.asked), "decisions": decisions, "effects": rows(plan)},
    )


def read_plan(run: Path, settings: NeilfConfig, before: int | None = None) -> Plan:
    """The plan of a run as it was after `before` steps (none: now). Without one, settings hold as they are.

    Raises:
        UserError: the file is damaged or of another version.
    """
    path = run / FILE
    if not path.is_file():
        return Plan.begin(Asked("as-set"), settings)
    stored = read_json(path)
    if stored.get("format") != FORMAT or not isinstance(stored.get("decisions"), list):
        raise UserError(
            f"{path}: a record of another version", "use the version of neilfpp that wrote the run"
        )
    try:
        decisions = [_decision(entry, str(path)) for entry in stored["decisions"]]
        asked = read_asked(stored["asked"])
    except (
        TypeError,
        AttributeError,
        KeyError,
    ) as error:  # Something that must be there is missing, or is no object.
        raise UserError(
            f"{path}: not a complete record ({error})", "restore the file or train again"
        ) from error
    return Plan(
        asked, settings, [d for d in decisions if before is None or d.before_training or d.step <= before]
    )


def _decision(entry: dict[str, Any], where: str) -> Decision:
    evidence = entry["evidence"]
    plain = from_dict(Decision, {name: value for name, value in entry.items() if name != "evidence"}, where)
    if plain.effect not in EFFECTS:
        raise UserError(
            f"{where}: no effect '{plain.effect}'", "use the version of neilfpp that wrote the run"
        )
    return dataclasses.replace(
        plain, evidence=None if evidence is None else from_dict(Measurement, evidence, where)
    )
