"""Poses are corrected in a training: decided on, applied to everything that follows, and resumed exactly."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from neilfpp_method.data.capture import Capture, load_capture
from neilfpp_method.data.files.images import write_exr, write_png
from neilfpp_method.data.files.json_entry import write_json
from neilfpp_method.effects import review
from neilfpp_method.effects.measurement import Measurement
from neilfpp_method.effects.request import parse_effects
from neilfpp_method.errors import Stopped
from neilfpp_method.fields.poses import PoseCorrections, PoseMotion
from neilfpp_method.settings.plain import changed
from neilfpp_method.settings.types import NeilfConfig
from neilfpp_method.train import evidence
from neilfpp_method.train.loop import train
from neilfpp_method.train.poses import camera_centers, corrected
from neilfpp_method.train.run import load_run
from tests.effects.evidence.test_poses import displacement, motions, rms
from tests.hard_cases.known_shapes import SHAPES, meet
from tests.train.small_runs import differences, small_config, small_training
from tests.train.test_resume import interrupt_at, run, state


def refined(fits: int = 3) -> NeilfConfig:
    """The small settings with ten steps of SDF init and so many fits of the poses."""
    return small_config(sdf_steps=10, material_steps=3, joint_steps=0, pose_fits=fits)


def test_a_stop_between_fits_changes_nothing(tmp_path, capture, monkeypatch):
    asked = parse_effects("none,+poses")
    run(capture, tmp_path / "whole", refined(), effects=asked)
    with monkeypatch.context() as patch:
        interrupt_at(patch, 4, 7)
        for resume in (False, True):
            with pytest.raises(Stopped):
                run(
                    None if resume else capture,
                    tmp_path / "run",
                    None if resume else refined(),
                    resume=resume,
                    effects=asked,
                )
    run(None, tmp_path / "run", resume=True)
    assert differences(state(tmp_path / "run"), state(tmp_path / "whole")) == []
    checks = [
        json.loads((tmp_path / name / "quality.json").read_text())["checks"] for name in ("run", "whole")
    ]
    assert [c["radiance"] for c in checks[0]] == [c["radiance"] for c in checks[1]]
    assert state(tmp_path / "run", "sdf_init")["model"]["poses.rotation"].abs().max() > 0


def test_a_loaded_run_has_the_corrected_cameras(tmp_path, capture):
    run(capture, tmp_path / "run", refined(), effects=parse_effects("none,+poses"))
    loaded, given = load_run(tmp_path / "run"), load_capture(capture)
    expected = corrected(given, loaded.model.poses)
    for ours, theirs, before in zip(
        loaded.capture.train_views, expected.train_views, given.train_views, strict=True
    ):
        assert np.array_equal(ours.camera.w2c, theirs.camera.w2c)
        assert not np.array_equal(ours.camera.w2c, before.camera.w2c)
    for ours, before in zip(loaded.capture.test_views, given.test_views, strict=True):
        assert np.array_equal(ours.camera.w2c, before.camera.w2c)


def test_everything_after_a_fit_uses_the_corrected_cameras(tmp_path, capture, monkeypatch):
    training = small_training(capture, tmp_path / "run", refined(fits=1), patches=1)
    motion, views = motions(2.0, views=len(training.pixels.views)), training.pixels
    monkeypatch.setattr(evidence, "next_motion", lambda *_: motion)
    shown = []
    training.preview = lambda model, capture, stage: shown.append(capture)
    train(training)
    moved = corrected(views.capture, training.model.poses)
    assert torch.equal(training.model.poses.rotation, motion.rotation)
    for held, given in (
        (training.quality.pixels, training.given.held_back),
        (training.watch.pixels, training.given.checked),
    ):
        assert torch.equal(held.directions, motion.of(given).directions)
    for capture_now in (training.pixels.capture, shown[0]):
        for view, expected in zip(capture_now.train_views, moved.train_views, strict=True):
            assert np.array_equal(view.camera.w2c, expected.camera.w2c)
    torch.testing.assert_close(
        training.pixels.view(0).directions, motion.of(views.view(0)).directions, atol=1e-6, rtol=0.0
    )


def test_poses_that_are_off_cost_nothing(tmp_path, capture, monkeypatch):
    def fail(*_):
        raise AssertionError("poses are fitted")

    for name in ("next_motion", "review_poses"):
        monkeypatch.setattr(evidence, name, fail)
    training = small_training(capture, tmp_path / "run", refined(fits=0))
    pixels, held_back = training.pixels, training.quality.pixels
    train(training)
    assert training.model.poses is None
    assert training.pixels is pixels
    assert training.quality.pixels is held_back
    assert not [name for name in training.model.state_dict() if name.startswith("poses")]


def test_poses_that_evidence_switches_off_stay_as_given(tmp_path, capture, monkeypatch):
    fitted = []
    monkeypatch.setattr(evidence, "next_motion", lambda *_: fitted.append(1))
    small = Measurement("gain", 0.005, 0.001, 0.01, 20)
    monkeypatch.setattr(review, "pose_evidence", lambda *_: small)
    run(capture, tmp_path / "run", refined(), effects=parse_effects("auto"))
    decisions = json.loads((tmp_path / "run" / "effects.json").read_text())["decisions"]
    (decided,) = [one for one in decisions if one["effect"] == "poses"]
    assert (decided["on"], decided["by"], decided["step"]) == (False, "evidence", 3)
    assert not fitted
    assert not load_run(tmp_path / "run").model.poses.rotation.any()


# ----------------------------------------------------------------------------------- a scene with noisy poses

SHAPE, SIDE, VIEWS, DISTANCE = "crevice", 48, 16, 3.0


def photographed(root: Path, noise: PoseMotion) -> Capture:
    """Photographs of two textured boxes, with inaccurate poses; it returns the capture of the true poses."""
    focal = SIDE * DISTANCE / 2
    tracks, files, box = {}, {}, np.diag([2.0, 2.0, 2.0, 1.0])
    for i in range(VIEWS):
        turn, height = i * np.pi * (3 - 5**0.5), 0.8 * (1 - (2 * i + 1) / VIEWS)
        flat = (1 - height**2) ** 0.5
        outward = np.array([np.cos(turn) * flat, np.sin(turn) * flat, height])
        right = np.cross(-outward, [0, 0, 1])
        right /= np.linalg.norm(right)
        w2c = np.eye(4)
        w2c[:3, :3] = np.stack([right, np.cross(-outward, right), -outward])
        w2c[:3, 3] = -w2c[:3, :3] @ (DISTANCE * outward)
        u, v = np.meshgrid(np.arange(SIDE) + 0.5, np.arange(SIDE) + 0.5)
        local = np.stack([(u - SIDE / 2) / focal, (v - SIDE / 2) / focal, np.ones_like(u)], -1).reshape(-1, 3)
        origins = np.broadcast_to(DISTANCE * outward, local.shape)
        seen = meet(SHAPES[SHAPE], origins, local @ w2c[:3, :3])
        color = seen.color * (1 + 0.5 * np.sin(15 * seen.position)) * seen.hit[:, None]
        image = color.reshape(SIDE, SIDE, 3).astype(np.float32)
        write_exr(root / f"inputs/images/{i:03d}.exr", {"RGB": image})
        mask = np.where(seen.hit, 255, 0).astype(np.uint8).reshape(SIDE, SIDE)
        write_png(root / f"inputs/masks/{i:03d}.png", mask)
        camera = {
            "intrinsic": {"focal": [focal] * 2, "ppt": [SIDE / 2] * 2},
            "extrinsic": w2c.ravel().tolist(),
        }
        tracks[str(i)] = {"flg": 2, "size": [SIDE, SIDE], "camera": camera}
        files[str(i)] = f"images/{i:03d}.exr"
    scene = {"camera_track_map": {"images": tracks}, "image_path": {"file_paths": files}}
    scene["bbox"] = {"transform": box.ravel().tolist()}
    write_json(root / "inputs" / "sfm_scene.json", scene)
    true, poses = load_capture(root, test_every=0), PoseCorrections(VIEWS)
    poses.set(noise)
    for track, view in zip(tracks.values(), corrected(true, poses).views, strict=True):
        track["camera"]["extrinsic"] = view.camera.w2c.ravel().tolist()
    write_json(root / "inputs" / "sfm_scene.json", scene)
    return true


@pytest.mark.slow
@pytest.mark.parametrize("degrees", [0.0, 1.0])
def test_noisy_poses_are_corrected(tmp_path, degrees):
    noise = motions(degrees, views=VIEWS)
    true = photographed(tmp_path / "boxes", noise)
    config = changed(
        small_config(sdf_steps=700, material_steps=0, joint_steps=0, rays=160, checkpoint_every=700),
        {
            "host.sdf.width": 32,
            "encoding.levels": 4,
            "encoding.log2_entries": 13,
            "encoding.sdf_log2_entries": 13,
            "encoding.max_resolution": 64,
            "radiance.width": 32,
            "host.volume.beta_init": 0.05,
            "host.volume.samples": 24,
            "train.pose_fits": 8,
        },
    )
    run(tmp_path / "boxes", tmp_path / "run", config, effects=parse_effects("auto"), test_every=0)
    loaded, centers = load_run(tmp_path / "run"), camera_centers(true)
    found = loaded.model.poses.motion
    left = PoseMotion(noise.rotation + found.rotation, noise.shift + found.shift)
    assert loaded.config.train.pose_fits == (8 if degrees else 0)
    assert rms(displacement(left, centers)) <= 0.5 * rms(displacement(noise, centers))
