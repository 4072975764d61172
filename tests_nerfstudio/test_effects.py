"""`ns-train neilfpp` decides on effects by evidence, as `neilfpp train` does."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.utils.eval_utils import eval_setup
from rich.console import Console

from neilfpp_method.effects import review
from neilfpp_method.effects.plan import Plan
from neilfpp_method.effects.request import parse_effects
from neilfpp_method.errors import UserError
from neilfpp_method.hosts import proxy
from neilfpp_method.kernels.process import computing_fast
from neilfpp_method.plugin import steps as plugin_steps
from neilfpp_method.plugin.effects import begin_plan, restore_decisions, stored_decisions
from neilfpp_method.settings.plain import changed
from neilfpp_method.settings.presets import EXPOSURE_RATE, fixed_geometry
from neilfpp_method.settings.types import NeilfConfig
from neilfpp_method.train import command
from neilfpp_method.train.command import run_training
from neilfpp_method.train.request import TrainingRequest
from neilfpp_method.train.run import load_run, run_folder
from tests.data.make_capture import make_capture
from tests.train.small_runs import differences
from tests_nerfstudio.runs import (
    checkpoint,
    ns_train,
    reduced_tabletop,
    small_settings,
    trainer_config,
    weights,
)

PLACES = 250
"""Number of places for the initial light, of which the small captures show 100 often enough."""
TABLETOP = changed(small_settings(), {"optimizer.exposure": EXPOSURE_RATE, "host.sdf.start": "sphere"})
BALL = changed(
    fixed_geometry(changed(TABLETOP, {"train.material_steps": 2})),
    {"radiance.layers": 1, "radiance.width": 16},
)
"""Material is trained from step 0 on, for six steps."""


@pytest.fixture(autouse=True, scope="module")
def few_places() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(review, "PLACES", PLACES)
        yield


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A matte ball in nine training views, with a point cloud: it has no metal, and occludes nothing."""
    return make_capture(tmp_path_factory.mktemp("ball"), views=10)


@pytest.fixture(scope="module")
def ball_run(ball: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return ns_train(on_ball(ball, tmp_path_factory.mktemp("run")))


@pytest.fixture(scope="module")
def tabletop(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return reduced_tabletop(tmp_path_factory.mktemp("tabletop"))


@pytest.fixture(scope="module")
def tabletop_run(tabletop: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return ns_train(trainer_config(tabletop, tmp_path_factory.mktemp("run"), TABLETOP, effects="auto"))


def on_ball(data: Path, out: Path) -> TrainerConfig:
    return trainer_config(data, out, BALL, method="neilfpp-mesh", effects="auto")


def effects(folder: Path) -> dict:
    return json.loads((folder / "effects.json").read_text())


def decided(folder: Path) -> dict[str, str]:
    return {row["effect"]: row["decision"] for row in effects(folder)["effects"]}


def standalone(data: Path, out: Path, settings: NeilfConfig, asked: str = "auto") -> Path:
    """The same training by `neilfpp train`, without held-back pixels, which nerfstudio does not have."""
    with pytest.MonkeyPatch.context() as patch, computing_fast():
        patch.setattr(command, "PATCHES", 0)
        request = TrainingRequest(data, out, settings, effects=parse_effects(asked), scale=1.0, device="cpu")
        return run_training(request, Console(quiet=True))


# -------------------------------------------------------------------------------- as in the standalone loop


def test_both_loops_decide_alike_on_a_given_mesh(ball: Path, ball_run: Path, tmp_path: Path) -> None:
    own = standalone(ball, tmp_path / "own", BALL)
    assert effects(ball_run / "neilfpp") == effects(own)
    assert differences(weights(ball_run), dict(load_run(own).model.state_dict())) == []
    measured = {row["effect"] for row in effects(own)["effects"] if row["samples"]}
    assert measured >= {"inter-reflection", "metals", "lamps", "exposure", "lobe-sampling", "long-tails"}
    assert {decided(own)[name] for name in ("inter-reflection", "metals")} == {"off"}


def test_both_loops_decide_alike_on_a_recovered_surface(
    tabletop: Path, tabletop_run: Path, tmp_path: Path
) -> None:
    own = standalone(tabletop, tmp_path / "own", TABLETOP)
    assert effects(tabletop_run / "neilfpp") == effects(own)
    assert differences(weights(tabletop_run), dict(load_run(own).model.state_dict())) == []
    steps = {d["step"] for d in effects(own)["decisions"] if d["by"] == "evidence"}
    assert steps >= {4, 8}, "before both stages with material"
    assert "open" not in decided(own).values()


def test_both_loops_train_the_same_gains_of_photographs(ball: Path, tmp_path: Path) -> None:
    asked, settings = "none,+exposure", changed(TABLETOP, {"train.sdf_steps": 2})
    inside = ns_train(trainer_config(ball, tmp_path / "inside", settings, effects=asked))
    own = standalone(ball, tmp_path / "own", settings, asked)
    gains = [name for name in weights(inside) if name.startswith("gains.")]
    assert gains
    assert differences(weights(inside), dict(load_run(own).model.state_dict())) == []
    assert (inside / "neilfpp" / "scene.json").read_text() == (own / "scene.json").read_text()


# ----------------------------------------------------------------------------------- decisions that are kept


def test_the_commands_use_the_decided_settings(ball_run: Path) -> None:
    loaded = load_run(run_folder(ball_run / "config.yml"))
    _, pipeline, _, _ = eval_setup(ball_run / "config.yml")
    for config in (loaded.config, loaded.model.config, pipeline.model.neilf.config):
        assert not config.brdf.metals
        assert config.light.inter_reflection == "off"
    assert effects(ball_run) == effects(ball_run / "neilfpp"), "also beside config.yml"


@pytest.mark.parametrize("stop", [3, 4], ids=["within a stage", "between stages"])
def test_a_resumed_run_keeps_its_decisions(stop: int, request, tmp_path: Path) -> None:
    capture = "ball" if stop == 3 else "tabletop"
    data, whole = request.getfixturevalue(capture), request.getfixturevalue(f"{capture}_run")

    def config(out: Path) -> TrainerConfig:
        if capture == "ball":
            return on_ball(data, out)
        return trainer_config(data, out, TABLETOP, effects="auto")

    first = config(tmp_path / "first")
    first.max_num_iterations = stop
    second = config(tmp_path / "second")
    second.load_dir = ns_train(first) / "nerfstudio_models"
    second = ns_train(second)
    assert effects(second / "neilfpp") == effects(whole / "neilfpp")
    assert differences(checkpoint(whole)["pipeline"], checkpoint(second)["pipeline"]) == []


def test_decisions_of_another_request_are_refused() -> None:
    plan = begin_plan("auto", TABLETOP)
    restore_decisions(plan, stored_decisions(begin_plan("auto", TABLETOP)))
    with pytest.raises(UserError, match=r"is 'auto', but .* with 'auto,-metals'.*effects auto,-metals"):
        restore_decisions(plan, stored_decisions(begin_plan("-metals", TABLETOP)))


# --------------------------------------------------------------------------------- what is asked and recorded


def test_as_set_measures_nothing(ball: Path, tmp_path: Path) -> None:
    config = trainer_config(ball, tmp_path, BALL, method="neilfpp-mesh", effects="as-set")
    config.max_num_iterations = 1
    run = ns_train(config)
    assert {d["by"] for d in effects(run)["decisions"]} <= {"settings", "files"}
    assert load_run(run / "neilfpp").config.light.inter_reflection == BALL.light.inter_reflection
    assert load_run(run / "neilfpp").config.brdf == BALL.brdf


@pytest.mark.parametrize("asked", ["auto", "all", "as-set"])
def test_poses_are_recorded_as_not_measured(asked: str) -> None:
    plan = begin_plan(asked, changed(TABLETOP, {"train.pose_fits": 3}))
    newest = plan.newest("poses")
    assert not newest.on
    assert newest.reason.startswith("not measured: nerfstudio")
    assert plan.config_of_model.train.pose_fits == 0


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        ("+poses", r"not corrected in nerfstudio"),
        ("-lamp", "mean 'lamps'"),
        ("+response", "response"),
    ],
)
def test_what_cannot_be_decided_is_refused(asked: str, words: str) -> None:
    with pytest.raises(UserError, match=words):
        begin_plan(asked, TABLETOP)


@pytest.mark.parametrize(("share", "steps"), [(0.0, 2), (0.5, 5)])
def test_the_proxy_of_another_method_follows_it_while_rays_are_traced(
    share: float, steps: int, tmp_path: Path, monkeypatch
) -> None:
    monkeypatch.setattr(proxy, "EXPLORING_BATCHES", 1)
    monkeypatch.setattr(plugin_steps, "CHECKED_PIXELS", 16)
    monkeypatch.setattr(review, "SURFACE_PIXELS", 64)
    traced, measure = [], review.self_visibility

    def measured(model, settings, position, normal):
        traced.append(model.scene is not None)
        return dataclasses.replace(
            measure(model, settings, position, normal), value=share, deviation=0.0, samples=64
        )

    monkeypatch.setattr(review, "self_visibility", measured)
    settings = small_settings(sdf_steps=2, material_steps=2, joint_steps=1)
    settings = dataclasses.replace(settings, shading=dataclasses.replace(settings.shading, hit_share=0.05))
    data = make_capture(tmp_path / "capture", size=(8, 6), test=(0, 1))
    run = ns_train(trainer_config(data, tmp_path / "run", settings, host="nerfacto", effects="auto"))
    assert traced[0], "on the proxy"
    assert decided(run)["inter-reflection"] == ("on" if share else "off")
    assert checkpoint(run)["pipeline"]["_model.proxy._extra_state"]["steps"] == steps
    kept = Plan.begin(parse_effects("auto"), settings)
    restore_decisions(kept, checkpoint(run)["pipeline"]["_model._extra_state"])
    assert kept.newest("inter-reflection").on == bool(share)
