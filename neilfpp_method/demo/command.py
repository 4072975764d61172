"""`neilfpp demo`: train on the scene in the package, measure, and write a report to look at."""

from __future__ import annotations

import dataclasses
from importlib import resources
from pathlib import Path

from rich.console import Console

from neilfpp_method.effects.asked import read_asked
from neilfpp_method.evaluate.protocols import evaluate, write_metrics
from neilfpp_method.evaluate.sheet import write_contact_sheet
from neilfpp_method.evaluate.views import render_test_views
from neilfpp_method.report.write import REPORT, ReportOptions, write_report
from neilfpp_method.settings.presets import preset
from neilfpp_method.settings.types import NeilfConfig
from neilfpp_method.train.command import run_training
from neilfpp_method.train.device import pick_device
from neilfpp_method.train.run import load_run

__all__ = ["demo_config", "demo_scene", "run_demo"]

STEPS = {"sdf_steps": 1600, "material_steps": 1200, "joint_steps": 100}
"""Of the three stages: some less than the preset has, for five to ten minutes on two cores of today."""
VIEWS = 3
"""In the report."""
SHORT = 20
"""A short demo takes one step in so many."""


def demo_scene() -> Path:
    """The capture in the package: a table top under three lamps, 24 views to learn from and 4 to test on."""
    return Path(str(resources.files("neilfpp_method.demo") / "scene"))


def demo_config(short: bool) -> NeilfConfig:
    """The preset `fast` with fewer steps; short: hardly any."""
    config = preset("fast")
    steps = {name: count // SHORT for name, count in STEPS.items()} if short else STEPS
    return dataclasses.replace(config, train=dataclasses.replace(config.train, **steps))


def run_demo(out: Path, *, short: bool, resume: bool, device: str, console: Console) -> Path:
    """Train, evaluate, write `report.html` and `contact_sheet.png` into `out`; returns the report's path."""
    run_training(
        data=demo_scene(),
        out=out,
        config=None if resume else demo_config(short),
        resume=resume,
        test_every=None,
        response="auto",
        device=device,
        devices=1,
        console=console,
        effects=None if resume else read_asked("auto"),
        command="neilfpp demo",
    )
    run = load_run(out, pick_device(device))
    console.print("measuring on the test views …")
    rendered = render_test_views(run)
    metrics = evaluate(run, rendered=rendered)
    write_metrics(out / "metrics.json", run, metrics)
    console.print("drawing the report …")
    write_contact_sheet(run, out / "contact_sheet.png", rendered)
    report = write_report(out, out / REPORT, ReportOptions(VIEWS, confidence=True), str(pick_device(device)))
    console.print(f"done: open {report}", soft_wrap=True)
    return report
