"""Patches of the training views are compared in SDF init, with the cameras in use, and resumed exactly."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from neilfpp_method.errors import Stopped
from neilfpp_method.fields.poses import PoseCorrections, PoseMotion
from neilfpp_method.hosts import patches as comparison
from neilfpp_method.schedule import Stage
from neilfpp_method.settings.plain import changed
from neilfpp_method.settings.presets import fixed_geometry, preset
from neilfpp_method.settings.types import NeilfConfig
from neilfpp_method.structures import LossTerm
from neilfpp_method.train import rerun
from neilfpp_method.train.loop import train
from neilfpp_method.train.patches import pose_patches, show_patches
from neilfpp_method.train.poses import corrected
from neilfpp_method.train.run import CaptureSource, create_run
from tests.data.make_capture import make_capture
from tests.train.small_runs import differences, small_config, small_training
from tests.train.test_resume import interrupt_at, run, state


@pytest.fixture(scope="module")
def ring(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A ball seen by 24 cameras around it, 15° apart."""
    return make_capture(tmp_path_factory.mktemp("capture") / "ring", views=24, size=(32, 24))


@pytest.fixture(autouse=True)
def compare_everything(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compare patches of three pixels a side, large in the small images, also where there is only fog."""
    for name, value in (("HALF_WIDTH", 1), ("MIN_CONTRAST", 1e-4), ("MAX_STEP", 1.0), ("MAX_EXTENT", 1.0)):
        monkeypatch.setattr(comparison, name, value)


def with_patches(**train: int) -> NeilfConfig:
    values = {"host.loss.patches": 0.5, "shading.hit_share": 0.01, "host.sdf.start": "sphere"}
    return changed(small_config(**train), values)


def test_the_presets_for_photographs_compare_patches():
    assert all(preset(name).host.loss.patches > 0 for name in ("fast", "balanced", "best"))


def test_images_are_kept_only_while_they_are_compared(tmp_path, ring):
    training = small_training(ring, tmp_path, with_patches())
    model, pixels = training.model, training.pixels
    for stage, shown in ((Stage.SDF_INIT, True), (Stage.MATERIAL_INIT, False), (Stage.JOINT, False)):
        show_patches(model, pixels, stage)
        assert (model.host.patch_views is not None) is shown
    show_patches(model, pixels, Stage.SDF_INIT)
    assert model.losses(pixels.sample(64), Stage.SDF_INIT)["patches"].values.any()
    model.use(changed(with_patches(), {"host.loss.patches": 0.0}))
    show_patches(model, pixels, Stage.SDF_INIT)
    assert model.host.patch_views is None
    assert "patches" not in model.losses(pixels.sample(64), Stage.SDF_INIT)


def test_a_mesh_has_no_patches_to_compare(tmp_path, ring):
    training = small_training(ring, tmp_path, fixed_geometry(with_patches()))
    show_patches(training.model, training.pixels, Stage.SDF_INIT)
    assert not hasattr(training.model.host, "patch_views")


def test_views_that_are_too_far_apart_are_trained_without(tmp_path, capture):
    """Six cameras around a ball: none sees it from nearby another one."""
    training = small_training(capture, tmp_path / "run", with_patches(sdf_steps=2, material_steps=0))
    create_run(training.path, training.config, CaptureSource(str(capture)), training.model.facts)
    train(training)
    assert training.model.host.patch_views is None
    assert training.skipped == 0


def test_corrected_cameras_are_used(tmp_path, ring):
    training = small_training(ring, tmp_path, with_patches())
    model, pixels = training.model, training.pixels
    show_patches(model, pixels, Stage.SDF_INIT)
    before = model.host.patch_views.w2c.clone()
    count = len(pixels.views)
    poses = PoseCorrections(count)
    poses.set(PoseMotion(torch.zeros(count, 3), 0.1 * torch.ones(count, 3)))
    pose_patches(model, pixels.posed(corrected(pixels.capture, poses)))
    assert not torch.allclose(model.host.patch_views.w2c, before, atol=1e-3)


def test_a_stop_changes_nothing(tmp_path, ring, monkeypatch):
    config = with_patches(sdf_steps=4, material_steps=1, joint_steps=1)
    run(ring, tmp_path / "whole", config)
    with monkeypatch.context() as patch:
        interrupt_at(patch, 1)
        with pytest.raises(Stopped):
            run(ring, tmp_path / "run", config)
    run(None, tmp_path / "run", resume=True)
    assert differences(state(tmp_path / "run"), state(tmp_path / "whole")) == []


def test_a_rerun_compares_patches(tmp_path, ring, monkeypatch):
    config = with_patches(sdf_steps=2, material_steps=0, joint_steps=0)
    training = small_training(ring, tmp_path / "run", config)
    create_run(training.path, config, CaptureSource(str(ring)), training.model.facts)
    values, honest = [], training.model.step

    def spoiled(*arguments):
        computed = honest(*arguments)
        values.append(computed.terms["patches"].values.detach().clone())
        terms = {name: LossTerm(term.values * torch.nan) for name, term in computed.terms.items()}
        return computed if len(values) == 1 else computed._replace(terms=terms)

    training.model.step = spoiled
    train(training)
    again, weigh = [], rerun.weigh

    def remembering(terms, weights):
        again.append(terms["patches"].values.detach())
        return weigh(terms, weights)

    monkeypatch.setattr(rerun, "weigh", remembering)
    rerun.rerun_step(training.path, 1)
    assert values[1].any()
    torch.testing.assert_close(again[0], values[1], rtol=0, atol=0)
