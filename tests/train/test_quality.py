"""Held-back pixels are measured while a run trains, without any influence on the training."""

from __future__ import annotations

import json
import math
from itertools import pairwise

import pytest
import torch
from rich.console import Console

from neilfpp_method.errors import Stopped, UserError
from neilfpp_method.schedule import Stage, StagePosition
from neilfpp_method.train import quality
from neilfpp_method.train.command import run_training
from neilfpp_method.train.loop import train
from neilfpp_method.train.quality import FILE, MAX_SHARE, Quality, QualityCheck, read_checks
from neilfpp_method.train.request import TrainingRequest
from tests.data.make_capture import make_capture
from tests.scenes import sphere_batch, sphere_model
from tests.train.small_runs import differences, short_light_fits, small_config, small_training, solved_light
from tests.train.test_resume import interrupt_at, state


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return make_capture(tmp_path_factory.mktemp("capture") / "sphere", size=(48, 36), masks=True)


def train_here(data, out, resume=False, **settings):
    config = None if resume else solved_light(small_config(**settings))
    run_training(TrainingRequest(data, out, config, resume, device="cpu"), Console(quiet=True))


@short_light_fits()
def test_checks_do_not_change_the_training_and_continue_after_a_stop(tmp_path, capture, monkeypatch):
    """Checks after every step, checks only at the ends of stages, and a stopped run."""
    train_here(capture, tmp_path / "seldom")
    monkeypatch.setattr(quality, "MIN_STEPS", 1)
    monkeypatch.setattr(quality, "MAX_SHARE", 1.0)
    train_here(capture, tmp_path / "often")
    with monkeypatch.context() as patch:
        interrupt_at(patch, 6)
        with pytest.raises(Stopped):
            train_here(capture, tmp_path / "stopped")
    train_here(None, tmp_path / "stopped", resume=True)

    assert [check.step for check in read_checks(tmp_path / "seldom")] == [4, 8, 12]
    checks = read_checks(tmp_path / "often")
    assert [check.step for check in checks] == list(range(1, 13))
    assert [check.physical is None for check in checks] == [True] * 4 + [False] * 8
    assert all(later.seconds > check.seconds for check, later in pairwise(checks))
    for name in ("seldom", "stopped"):
        assert differences(state(tmp_path / name), state(tmp_path / "often")) == []
    again = read_checks(tmp_path / "stopped")
    assert [check.step for check in again] == list(range(1, 13))
    assert [check.radiance for check in again] == [check.radiance for check in checks]
    assert [check.step for check in read_checks(tmp_path / "often", before=7)] == list(range(1, 8))


def test_the_psnr_is_that_of_clipped_srgb_values():
    """R and PBR of a model compared with pixels at a known difference in display values."""
    model = sphere_model(response="srgb")
    model.eval()
    batch = sphere_batch(32)
    maps = model.maps(batch.rays)
    for off in (0.1, 0.01):
        # A photograph that is brighter than R by `off` in display values, unless that clips.
        shown = quality.tone_map(maps.rgb_volume)
        batch.color.copy_(shown + torch.where(shown > 0.5, -off, off))
        watch = Quality(batch)
        watch.check_when_due(model.train(), StagePosition(Stage.JOINT, 4, 4), 12, 1.0)
        assert watch.checks[0].radiance == pytest.approx(-20 * math.log10(off), abs=1e-3)
        assert watch.checks[0].physical is not None
        assert model.training


def test_checks_are_rare_and_cheap(monkeypatch):
    monkeypatch.setattr(quality, "_measure", lambda *_: quality._Measured(20.0, None))
    watch = Quality(sphere_batch(4))
    model = sphere_model()
    for number in range(1, 3001):
        watch.check_when_due(model, StagePosition(Stage.SDF_INIT, number, 3000), number, 1e9)
    assert [check.step for check in watch.checks] == list(range(300, 3001, 300))
    for number in range(1, 501):
        watch.check_when_due(model, StagePosition(Stage.JOINT, number, 500), 3000 + number, 1e9)
    assert [check.step for check in watch.checks[10:]] == [3200, 3400, 3500]
    # Checks that took too much time are postponed, except that at the end of a stage.
    watch = Quality(sphere_batch(4), [QualityCheck(10, "sdf_init", 10.0, 1.0, None, took=1.0)])
    for seconds, checks in ((0.9 / MAX_SHARE, 1), (1.1 / MAX_SHARE, 2)):
        watch.check_when_due(model, StagePosition(Stage.JOINT, 400, 900), 1000, seconds)
        assert len(watch.checks) == checks
    watch.check_when_due(model, StagePosition(Stage.JOINT, 900, 900), 1500, 1.0)
    assert watch.checks[-1].step == 1500


def test_a_very_small_capture_is_not_checked(tmp_path):
    training = small_training(make_capture(tmp_path / "sphere", size=(8, 6)), tmp_path, small_config())
    assert not len(training.quality.pixels)
    train(training)
    assert read_checks(tmp_path) == []
    assert json.loads((tmp_path / FILE).read_text())["pixels"] == 0


@pytest.mark.parametrize(
    "damage",
    [
        {"format": 9},
        {"format": 1},
        {"format": 1, "checks": [1]},
        {"format": 1, "checks": [{"step": 1}]},
        {
            "format": 1,
            "checks": [
                {"step": 1, "stage": "joint", "seconds": 1e999, "radiance": 1, "physical": None, "took": 0}
            ],
        },
    ],
)
def test_a_damaged_record_is_named(tmp_path, damage):
    (tmp_path / FILE).write_text(json.dumps(damage))
    with pytest.raises(UserError, match=r"quality\.json"):
        read_checks(tmp_path)
