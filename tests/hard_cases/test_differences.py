"""Gradients of whole renders and whole steps compared with finite differences, in float64.

The positions of samples and the directions of incident light depend on the parameters without gradient, so
samples are drawn once and kept while the parameters change. Random directions in the space of all parameters
of a field are used: the slope along each by autograd agrees with the difference of two renders.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from types import ModuleType

import pytest
import torch
import trimesh
from torch import Tensor

import neilfpp_method.hosts.volsdf as volsdf_module
import neilfpp_method.incident.scene as scene_module
import neilfpp_method.model as model_module
from neilfpp_method.hosts.mesh import MeshHost
from neilfpp_method.model import NeilfModel
from neilfpp_method.schedule import Stage, active_losses, weigh
from neilfpp_method.settings.plain import changed
from neilfpp_method.settings.presets import fixed_geometry
from neilfpp_method.settings.types import NeilfConfig
from neilfpp_method.structures import PixelBatch
from tests.hosts.test_mesh import mesh_facts, mesh_of
from tests.scenes import sphere_batch, sphere_model, tiny_config
from tests.train.small_runs import solved_light

STEP = 1e-6
"""Length of the step in the parameters; rounding of float64 then changes a slope of 1 by 1e-9."""


def keep_first(monkeypatch: pytest.MonkeyPatch, module: ModuleType, name: str) -> list:
    """Replace a function so that every call returns the result of the first. Returns a list with it."""
    function, kept = getattr(module, name), []

    def once(*args, **kwargs):
        if not kept:
            kept.append(function(*args, **kwargs))
        return kept[0]

    monkeypatch.setattr(module, name, once)
    return kept


@pytest.fixture
def samples_stay(monkeypatch):
    keep_first(monkeypatch, volsdf_module, "error_bounded_samples")
    keep_first(monkeypatch, model_module, "sample_directions")


def small_config(light: str, mode: str = "off") -> NeilfConfig:
    """Gradients are not scaled, and every ray with any weight counts as a hit."""
    config = tiny_config() if light == "free" else solved_light(tiny_config())
    return changed(
        config,
        {
            "loss": {"position_gradient": 1.0, "normal_gradient": 1.0},
            # L_Hess is computed about hits that count as constants, so its slope is not that of a difference.
            "host.loss": {"hessian": (0.0, 0.0, 0.0)},
            "shading.normals": "host",
            "light.inter_reflection": mode,
            "shading.hit_share": 0.3,
        },
    )


def small_model(light: str) -> NeilfModel:
    return unsettled(sphere_model(small_config(light)))


def torus_model(light: str) -> NeilfModel:
    """A mesh whose points receive light from each other."""
    torch.manual_seed(0)
    config = fixed_geometry(small_config(light, "hard"))
    host = MeshHost(mesh_of(trimesh.creation.torus(0.5, 0.3)), config, mesh_facts())
    return unsettled(NeilfModel(host, config, mesh_facts()))


def unsettled(model: NeilfModel) -> NeilfModel:
    model = model.double().train()
    with torch.no_grad():  # away from the initial values, at which weights are exactly 0
        for parameters in model.parameter_groups().values():
            for p in parameters:
                p.add_(0.01 * torch.randn_like(p))
    return model


def pixels() -> PixelBatch:
    batch = sphere_batch(24)
    floats = {f.name: getattr(batch, f.name) for f in dataclasses.fields(batch) if f.name != "view"}
    return dataclasses.replace(batch, **{name: value.double() for name, value in floats.items()})


def assert_slopes(model: NeilfModel, value: Callable[[], Tensor], trained: frozenset[str]) -> None:
    """Compare the slope of `value` along random directions of each field's parameters, by autograd and by
    differences.
    """
    groups = {name: p for name, p in model.parameter_groups().items() if name in trained}
    slopes = {}
    for name, parameters in groups.items():
        gradient = torch.autograd.grad(value(), parameters, allow_unused=True, materialize_grads=True)
        torch.manual_seed(7)
        direction = [torch.randn_like(p) for p in parameters]
        along = sum((g * d).sum() for g, d in zip(gradient, direction, strict=True)).item()
        ends = []
        for sign in (1.0, -1.0):
            with torch.no_grad():
                for p, d in zip(parameters, direction, strict=True):
                    p.add_(sign * STEP * d)
                ends.append(value().item())
                for p, d in zip(parameters, direction, strict=True):
                    p.sub_(sign * STEP * d)
        slopes[name] = (along, (ends[0] - ends[1]) / (2 * STEP))
    assert any(abs(along) > 1e-4 for along, _ in slopes.values()), slopes
    for name, (along, difference) in slopes.items():
        assert along == pytest.approx(difference, rel=1e-3, abs=1e-6), (name, slopes)


def assert_slopes_of_stage(model: NeilfModel, batch: PixelBatch, stage: Stage) -> None:
    """All losses of a stage together, with their weights, and all fields that the stage trains."""
    model.freeze_for(stage)
    weights = active_losses(stage, model.config, model.stages)

    def value() -> Tensor:
        torch.manual_seed(5)
        return weigh(model.losses(batch, stage), weights).loss

    trained = model.stages[stage].trains & set(model.parameter_groups())
    trained = frozenset(name for name in trained if model.parameter_groups()[name])
    assert_slopes(model, value, trained)


@pytest.mark.parametrize("output", ["color", "position", "normal", "opacity"])
def test_renders_of_the_host(samples_stay, output):
    model, batch = small_model("free"), pixels()
    torch.manual_seed(3)
    weight = torch.randn_like(getattr(model.host.render(batch.rays), output))

    def value() -> Tensor:
        return (weight * getattr(model.host.render(batch.rays), output)).sum()

    trained = frozenset(model.parameter_groups()) - {"brdf", "light"}
    assert_slopes(model, value, trained)


@pytest.mark.parametrize("light", ["free", "map"])
@pytest.mark.parametrize("stage", list(Stage))
def test_slopes_of_all_losses_of_a_step_agree_with_differences(samples_stay, light, stage):
    model, batch = small_model(light), pixels()
    assert_slopes_of_stage(model, batch, stage)


@pytest.mark.parametrize("light", ["free", "map"])
@pytest.mark.parametrize("stage", [Stage.MATERIAL_INIT, Stage.JOINT])
def test_slopes_of_all_losses_on_a_mesh_with_hard_inter_reflection(samples_stay, monkeypatch, light, stage):
    """Light that arrives from the mesh itself is a constant of the step, so it is traced once and kept."""
    model, batch = torus_model(light), pixels()
    traced = keep_first(monkeypatch, scene_module, "scene_light")
    assert_slopes_of_stage(model, batch, stage)
    assert 0.05 < (traced[0].radiance > 0).any(-1).double().mean() < 0.95
