"""The effects of a run, stored in `RUN/effects.json` and read when a run is resumed or loaded.

The keys of the file are

- `format`: 1;
- `request`: the value of `--effects`;
- `decisions`: all decisions in order, with the attributes of `effects.plan.Decision`;
- `effects`: a row per effect (`effects.table.rows`), which follows from the decisions and is stored for other
  programs.
"""

from __future__ import annotations

from pathlib import Path

from neilfpp_method.data.files.json_entry import write_json
from neilfpp_method.effects.plan import Plan, stored_decision
from neilfpp_method.effects.request import EffectRequest, parse_effects
from neilfpp_method.effects.table import rows
from neilfpp_method.errors import UserError
from neilfpp_method.settings.types import NeilfConfig
from neilfpp_method.train.json_files import read_json

__all__ = ["read_plan", "write_plan"]

FORMAT = 1
FILE = "effects.json"


def write_plan(run: Path, plan: Plan) -> None:
    """Write the decisions so far, and the table that follows from them, into the run folder."""
    write_json(
        run / FILE,
        {"format": FORMAT, "request": str(plan.request), "decisions": plan.stored(), "effects": rows(plan)},
    )


def read_plan(run: Path, settings: NeilfConfig, before: int | None = None) -> Plan:
    """Read the effects of a run.

    Args:
        run: the run folder.
        settings: the settings of the run.
        before: number of steps after which the plan is wanted; None for the newest plan.

    Returns:
        The plan; if the run has no record, a plan that leaves the settings as they are.

    Raises:
        UserError: if the file is damaged or of another version.
    """
    path = run / FILE
    if not path.is_file():
        return Plan.begin(EffectRequest("as-set"), settings)
    stored = read_json(path)
    if stored.get("format") != FORMAT or not isinstance(stored.get("decisions"), list):
        raise UserError(
            f"{path}: a record of another version", "use the version of neilfpp that wrote the run"
        )
    try:
        request = parse_effects(stored["request"])
    except (AttributeError, KeyError) as error:
        raise UserError(
            f"{path}: not a complete record ({error})", "restore the file or train again"
        ) from error
    decisions = [stored_decision(entry, str(path)) for entry in stored["decisions"]]
    if before is not None:
        decisions = [one for one in decisions if one.before_training or one.step <= before]
    return Plan(request, settings, decisions)
