"""`neilfpp demo`: train on the example scene of the package, evaluate, and write a report."""

from __future__ import annotations

import dataclasses
from importlib import resources
from pathlib import Path

from rich.console import Console

from neilfpp_method.effects.request import parse_effects
from neilfpp_method.evaluate.protocols import evaluate, write_metrics
from neilfpp_method.evaluate.sheet import write_contact_sheet
from neilfpp_method.evaluate.views import render_test_views
from neilfpp_method.report.write import REPORT, ReportOptions, write_report
from neilfpp_method.settings.presets import preset
from neilfpp_method.settings.types import NeilfConfig
from neilfpp_method.train.command import run_training
from neilfpp_method.train.device import pick_device
from neilfpp_method.train.request import TrainingRequest
from neilfpp_method.train.run import load_run

__all__ = ["demo_config", "demo_scene", "run_demo"]

STEPS = {"sdf_steps": 2000, "material_steps": 1200, "joint_steps": 100}
"""Steps of the three stages: fewer than in the preset, for five to ten minutes on two current CPU cores."""
VIEWS = 3
"""Number of views in the report."""
SHORT = 20
"""Divisor of the numbers of steps in a short demo."""


def demo_scene() -> Path:
    """Folder of the example capture: a table top under three lamps, with 24 training and 4 test views."""
    return Path(str(resources.files("neilfpp_method.demo") / "scene"))


def demo_config(short: bool) -> NeilfConfig:
    """The preset `fast` with fewer steps, or with very few if `short`."""
    config = preset("fast")
    steps = {name: count // SHORT for name, count in STEPS.items()} if short else STEPS
    return dataclasses.replace(config, train=dataclasses.replace(config.train, **steps))


def run_demo(out: Path, *, short: bool, resume: bool, device: str, console: Console) -> Path:
    """Train, evaluate, and write `report.html` and `contact_sheet.png` into `out`.

    Returns:
        The path of the report.
    """
    request = TrainingRequest(
        data=demo_scene(),
        out=out,
        config=None if resume else demo_config(short),
        resume=resume,
        effects=None if resume else parse_effects("auto"),
        device=device,
        command="neilfpp demo",
    )
    run_training(request, console)
    run = load_run(out, pick_device(device))
    console.print("evaluating the test views …")
    rendered = render_test_views(run)
    metrics = evaluate(run, rendered=rendered)
    write_metrics(out / "metrics.json", run, metrics)
    console.print("writing the report …")
    write_contact_sheet(run, out / "contact_sheet.png", rendered)
    report = write_report(out, out / REPORT, ReportOptions(VIEWS, confidence=True), str(pick_device(device)))
    console.print(f"done: open {report}", soft_wrap=True)
    return report
