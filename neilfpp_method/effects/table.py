"""A plan of effects as a table for the terminal, and as plain values for `effects.json`."""

from __future__ import annotations

from typing import Any

from rich.box import SIMPLE_HEAD
from rich.table import Table

from neilfpp_method.effects.catalogue import EFFECTS, switched
from neilfpp_method.effects.plan import Plan

__all__ = ["effects_table", "rows"]

OPEN = "open"
"""Value of `decision` for an effect on which nothing has been decided yet."""


def rows(plan: Plan) -> list[dict[str, Any]]:
    """A row for each effect with its newest decision, in the order of the catalogue.

    `decision` is "on", "off" or "open". `cost` is the cost of the effect when it is on. `value`, `deviation`,
    `threshold` and `samples` belong to the evidence; they are None if there is none.
    """
    config = plan.config
    result = []
    for name, effect in EFFECTS.items():
        newest = plan.newest(name)
        evidence = newest.evidence if newest else None
        simulated = (
            config if effect.obstacle(config) or effect.is_on(config) else switched(config, effect, on=True)
        )
        result.append(
            {
                "effect": name,
                "title": effect.title,
                "decision": OPEN if newest is None else "on" if newest.on else "off",
                "by": newest.by if newest else "evidence",
                "step": newest.step if newest else None,
                "reason": newest.reason if newest else "to be measured once there is a surface",
                "value": evidence.value if evidence else None,
                "deviation": evidence.deviation if evidence else None,
                "threshold": evidence.threshold if evidence else None,
                "samples": evidence.samples if evidence else None,
                "cost": effect.cost(simulated),
                "risk": effect.risk,
            }
        )
    return result


def effects_table(plan: Plan) -> Table:
    """A table of the effects for the terminal. From 80 columns on, lines break between words only."""
    result = Table(
        title=f"effects ({plan.request})", title_justify="left", box=SIMPLE_HEAD, padding=(0, 1, 0, 0)
    )
    result.add_column("effect", no_wrap=True)
    result.add_column("decision", no_wrap=True)
    for heading in ("reason", "cost when on", "risk when off"):
        result.add_column(heading, overflow="fold")
    for row in rows(plan):
        result.add_row(row["effect"], row["decision"], row["reason"], row["cost"], row["risk"])
    return result
