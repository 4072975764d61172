"""Each preset, at its real sizes, runs a step of every stage."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch

from neilfpp_method.hosts.volsdf import VolSdfHost
from neilfpp_method.model import NeilfModel
from neilfpp_method.schedule import Stage, active_losses, stage_steps, weigh
from neilfpp_method.settings.facts import SceneFacts
from neilfpp_method.settings.presets import PRESETS, preset
from neilfpp_method.structures import OrientedPoints
from tests.hosts.test_patches import views
from tests.scenes import sphere_batch


@pytest.mark.parametrize("name", PRESETS)
def test_a_step_of_every_stage(name):
    torch.manual_seed(0)
    config = preset(name)
    # An untrained surface is fog, so every ray with any weight is shaded here.
    config = dataclasses.replace(config, shading=dataclasses.replace(config.shading, hit_share=1e-3))
    facts = SceneFacts("linear", 0.2, 3.0, "constant", log_gains=(0.1, 0.0, 0.0, -0.1, 0.0, 0.0))
    direction = torch.nn.functional.normalize(torch.randn(50, 3), dim=-1)
    host = VolSdfHost(config, facts, points=OrientedPoints(0.6 * direction, direction))
    host.patch_views = views()
    model = NeilfModel(host, config, facts)
    batch = sphere_batch(6, spread=0.3)
    for stage in Stage:
        model.freeze_for(stage)
        expected = active_losses(stage, config)
        terms = model.losses(batch, stage)
        assert terms.keys() == expected.keys()  # every loss of the table, and no other
        weigh(terms, expected).loss.backward()
        moving = [p for p in model.parameters() if p.requires_grad and p.grad is not None]
        assert moving
        assert all(p.grad.isfinite().all() for p in moving)


def plain_settings(name: str) -> dict[str, object]:
    """The settings of a preset by their dotted names."""

    def leaves(part: object, path: str) -> dict[str, object]:
        if not dataclasses.is_dataclass(part):
            return {path: part}
        return {
            name: value
            for field in dataclasses.fields(part)
            for name, value in leaves(getattr(part, field.name), f"{path}.{field.name}").items()
        }

    return leaves(preset(name), name)


@pytest.mark.parametrize(("smaller", "larger"), [("fast", "balanced"), ("balanced", "best")])
def test_a_larger_preset_differs_only_in_sizes_and_steps(smaller, larger):
    before = {path.split(".", 1)[1]: value for path, value in plain_settings(smaller).items()}
    after = {path.split(".", 1)[1]: value for path, value in plain_settings(larger).items()}
    assert before.keys() == after.keys()
    changed = {path for path in before if before[path] != after[path]} - {"preset"}
    sizes = ("encoding.", "radiance.", "brdf.", "host.volume.", "shading.", "light.", "train.")
    assert all(path.startswith(sizes) for path in changed)
    assert all(type(before[path]) is int and before[path] < after[path] for path in changed)
    stages = ("sdf_steps", "material_steps", "joint_steps")
    assert {f"train.{name}" for name in (*stages, "rays")} <= changed


@pytest.mark.parametrize("name", ["fast", "balanced", "best"])
def test_the_page_on_budgets_has_the_sizes_of_the_presets(name):
    page = Path(__file__).parents[2] / "docs" / "budget.md"
    rows = [line.strip("| ").split(" | ") for line in page.read_text(encoding="utf-8").splitlines()]
    (row,) = [row for row in rows if row[0] == f"`{name}`"]
    config = preset(name)
    steps = tuple(stage_steps(config.train).values())
    rays = sum(steps) * config.train.rays / 1e6
    assert row[1:6] == [
        ", ".join(map(str, steps)),
        str(config.train.rays),
        str(config.shading.train_samples),
        str(config.encoding.max_resolution),
        f"{rays:.1f} million" if rays < 10 else f"{rays:.0f} million",
    ]
