"""The initial distance field: the hull of the masks or of the points, or a sphere with the reason."""

from __future__ import annotations

import dataclasses
import io
from pathlib import Path

import numpy as np
import pytest
import torch
from rich.console import Console

from neilfpp_method.data.capture import load_capture
from neilfpp_method.data.files.images import write_png
from neilfpp_method.data.pixels.dataset import PixelDataset
from neilfpp_method.hosts.volsdf import VolSdfHost
from neilfpp_method.model import NeilfModel
from neilfpp_method.schedule import Stage, StagePosition
from neilfpp_method.settings.plain import changed
from neilfpp_method.settings.types import NeilfConfig
from neilfpp_method.train import command
from neilfpp_method.train.build import build_model, scene_facts
from neilfpp_method.train.checkpoint import last_checkpoint, save_checkpoint
from neilfpp_method.train.optimizer import make_optimizer, seed_step, waiting_fields
from neilfpp_method.train.request import TrainingRequest
from neilfpp_method.train.start import GeometryStart, start_geometry
from tests.coarse_hulls import make_coarse
from tests.data.make_capture import RADIUS, SCALE, make_capture
from tests.train.small_runs import small_config

BALL = RADIUS / SCALE
SIZE = (64, 48)


@pytest.fixture(autouse=True)
def cheap(monkeypatch) -> None:
    make_coarse(monkeypatch)


@pytest.fixture
def masked(tmp_path: Path) -> Path:
    """Twelve views of a ball of radius 0.8 scene units; the first view is held out."""
    return make_capture(tmp_path / "capture", views=12, size=SIZE, masks=True)


def settings(begin: str = "hull") -> NeilfConfig:
    return changed(small_config(), {"host.sdf.start": begin})


def started(root: Path, config: NeilfConfig) -> tuple[NeilfModel, GeometryStart]:
    """An untrained model of the capture after its initialisation."""
    capture = load_capture(root)
    seed_step(config.train.seed, -1)
    model = build_model(
        capture, scene_facts(capture, PixelDataset(capture, capture.train_views), config), config
    )
    return model, start_geometry(model, capture, config)


def off_the_ball(model: NeilfModel) -> torch.Tensor:
    """G at points of the ball's surface: 0 if it is correct."""
    direction = torch.nn.functional.normalize(
        torch.randn(2000, 3, generator=torch.Generator().manual_seed(0)), dim=-1
    )
    with torch.no_grad():
        return model.host.sdf_field(BALL * direction)


def weights(model: NeilfModel) -> list[torch.Tensor]:
    return [parameter.detach().clone() for parameter in model.host.sdf_field.parameters()]


def test_the_field_starts_as_the_hull_of_the_masks(masked):
    sphere, plain = started(masked, settings("sphere"))
    hull, told = started(masked, settings())
    assert plain.text == "geometry starts as a sphere: as the settings say"
    assert told.text.startswith("geometry starts as the visual hull of 11 masks, to 0.0")
    assert told.error < 0.02
    # The hull of eleven views from a ring is slightly larger than the ball: G is negative on the ball.
    assert off_the_ball(sphere).abs().mean() > 0.1
    assert off_the_ball(hull).abs().mean() < 0.05
    with torch.no_grad():
        inside, outside = (
            hull.host.sdf_field(torch.tensor([[0.0, 0.0, z], [z, 0.0, 0.0]])) for z in (0.2, 1.3)
        )
    assert (inside < -0.3).all()
    assert (outside > 0.2).all()


def test_the_start_depends_on_the_seed_and_keeps_the_random_state(masked):
    config = settings()
    first, _ = started(masked, config)
    state = torch.get_rng_state()
    again, _ = started(masked, config)
    assert torch.equal(torch.get_rng_state(), state)
    assert all(torch.equal(a, b) for a, b in zip(weights(first), weights(again), strict=True))
    started(masked, settings("sphere"))
    assert torch.equal(torch.get_rng_state(), state), "training draws the same whatever it started as"


@pytest.mark.parametrize(("shape", "step", "length", "waiting"), [
    ("hull", 99, 1000, {"geometry", "beta"}),
    ("hull", 100, 1000, set()),
    ("hull", 59, 200, {"geometry", "beta"}),
    ("hull", 60, 200, set()),
    ("hull", 19, 40, {"geometry", "beta"}),
    ("hull", 20, 40, set()),
    ("sphere", 0, 1000, set()),
])  # fmt: skip
def test_geometry_waits_for_radiance_if_it_starts_from_the_hull(masked, shape, step, length, waiting):
    model, _ = started(masked, settings(shape))
    optimizer = model.config.optimizer
    at = StagePosition(Stage.SDF_INIT, step, length)
    assert waiting_fields(model, optimizer, at) - {"background"} == waiting
    assert waiting_fields(model, optimizer, StagePosition(Stage.JOINT, 0, 100)) == set()
    resumed = VolSdfHost(model.config, model.facts)
    resumed.load_state_dict(model.host.state_dict())
    assert resumed.starts_from_shape == (shape == "hull"), "a resumed run must wait as well"


def test_the_background_need_not_wait_if_it_starts_from_the_hull(masked):
    for shape, waits in (("hull", False), ("sphere", True)):
        model, _ = started(masked, settings(shape))
        optimizer = dataclasses.replace(model.config.optimizer, background_from=0.5)
        waiting = waiting_fields(model, optimizer, StagePosition(Stage.SDF_INIT, 0, 100))
        assert ("background" in waiting) == waits


def test_masks_of_test_views_are_not_used(masked):
    first, _ = started(masked, settings())
    write_png(masked / "inputs" / "masks" / "000.png", np.full(SIZE[::-1], 255, np.uint8))
    again, _ = started(masked, settings())
    assert all(torch.equal(a, b) for a, b in zip(weights(first), weights(again), strict=True))


def without_points(config: NeilfConfig) -> NeilfConfig:
    return changed(config, {"host.loss.point_cloud": 0.0})


def test_without_masks_it_is_the_hull_of_the_points(tmp_path):
    model, told = started(make_capture(tmp_path, views=12, size=SIZE), settings())
    assert told.text.startswith("geometry starts as the hull of 500 points, to 0.0")
    assert off_the_ball(model).abs().mean() < 0.1
    assert model.host.starts_from_shape


def test_without_masks_and_points_it_is_a_sphere_with_a_message(tmp_path):
    root = make_capture(tmp_path, views=4)
    plain, _ = started(root, without_points(settings("sphere")))
    model, told = started(root, without_points(settings()))
    reason = "the capture has no masks, and no points supervise the geometry"
    assert told == GeometryStart(reason=reason)
    assert all(torch.equal(a, b) for a, b in zip(weights(plain), weights(model), strict=True))


def test_masks_without_a_hull_are_a_warning(masked):
    for path in sorted((masked / "inputs" / "masks").iterdir()):
        write_png(path, np.full(SIZE[::-1], 255, np.uint8))
    plain, _ = started(masked, without_points(settings("sphere")))
    model, told = started(masked, without_points(settings()))
    assert (
        told.text
        == "warning: geometry starts as a sphere: the masks show something that extends beyond the scene box"
    )
    assert all(torch.equal(a, b) for a, b in zip(weights(plain), weights(model), strict=True))


def test_training_prints_its_start_and_a_resumed_run_does_not_start_again(masked, tmp_path, monkeypatch):
    """The loop is replaced: its initial state is saved as that after the first step."""

    def first_step(run: command.Training) -> None:
        path = last_checkpoint(run.path)
        if not path.exists():
            path.parent.mkdir(exist_ok=True)
            save_checkpoint(
                path, run.model, run.light_solver, make_optimizer(run.model, run.config.optimizer), 1
            )

    monkeypatch.setattr(command, "train", first_step)
    said = []
    for resume in (False, True):
        console = Console(file=io.StringIO(), width=200)
        data, config = (None, None) if resume else (masked, settings())
        request = TrainingRequest(data, tmp_path / "run", config, resume, device="cpu")
        command.run_training(request, console)
        said.append(console.file.getvalue())
    assert "geometry starts as the visual hull of 11 masks" in said[0]
    assert "geometry starts" not in said[1]
