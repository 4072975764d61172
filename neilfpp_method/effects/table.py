"""A plan as a table for the terminal, and as plain values for whoever reads a run."""

from __future__ import annotations

from typing import Any

from rich.table import Table

from neilfpp_method.effects.catalogue import EFFECTS, switched
from neilfpp_method.effects.plan import Plan

__all__ = ["rows", "table"]

OPEN = "open"


def rows(plan: Plan) -> list[dict[str, Any]]:
    """Every effect with what was decided last, in the order of the catalogue.

    `decision` is "on", "off" or "open"; `cost` is what the effect takes, and takes nothing when off; `value`,
    `deviation`, `threshold`, `samples` are those of the evidence, or null.
    """
    config = plan.config
    found = []
    for name, effect in EFFECTS.items():
        newest = plan.newest(name)
        evidence = newest.evidence if newest else None
        simulated = (
            config if effect.obstacle(config) or effect.is_on(config) else switched(config, effect, on=True)
        )
        found.append(
            {
                "effect": name,
                "title": effect.title,
                "decision": OPEN if newest is None else "on" if newest.on else "off",
                "by": newest.by if newest else "evidence",
                "step": newest.step if newest else None,
                "reason": newest.reason if newest else "evidence decides when there is a surface",
                "value": evidence.value if evidence else None,
                "deviation": evidence.deviation if evidence else None,
                "threshold": evidence.threshold if evidence else None,
                "samples": evidence.samples if evidence else None,
                "cost": effect.cost(simulated),
                "risk": effect.risk,
            }
        )
    return found


def table(plan: Plan) -> Table:
    """For the terminal."""
    shown = Table(title=f"effects ({plan.asked})", title_justify="left", show_lines=False)
    for heading in ("effect", "decision", "evidence", "cost when on", "left out by mistake"):
        shown.add_column(heading, overflow="fold")
    for row in rows(plan):
        shown.add_row(row["effect"], row["decision"], row["reason"], row["cost"], row["risk"])
    return shown
