"""Extreme scenes: a hundred steps of each stage (a dozen for merely unusual captures) end finite, without a
skipped step.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from neilfpp_method.data.cameras.projection import camera_rays
from neilfpp_method.data.capture import load_capture
from neilfpp_method.data.files.images import read_image, write_exr, write_png
from neilfpp_method.errors import UserError
from neilfpp_method.train.loop import train
from tests.data.make_capture import CENTER, RADIUS, SCALE, make_capture, srgb
from tests.train.small_runs import short_light_fits, small_config, small_training, solved_light

pytestmark = pytest.mark.usefixtures("without_shape_checks")

# Linear radiance as a function of the unit normal and the unit direction of the camera ray, both in the scene
# frame.
Look = Callable[[np.ndarray, np.ndarray], np.ndarray]


def repaint(root: Path, look: Look) -> Path:
    """Change the colours of the sphere of a capture; its surroundings are unchanged."""
    capture = load_capture(root)
    radius = RADIUS / SCALE
    for view in capture.views:
        rays = camera_rays(capture.scene_camera(view))
        o, d = rays.origins.double().numpy(), rays.directions.double().numpy()
        # |o + t d|² = r²
        b = (o * d).sum(-1)
        under_root = b**2 - (o**2).sum(-1) + radius**2
        hit = under_root > 0
        normal = (o + (-b - np.sqrt(under_root.clip(0)))[:, None] * d) / radius
        painted = np.where(hit[:, None], look(normal, d), 0.0).reshape(
            view.camera.height, view.camera.width, 3
        )
        hit = hit.reshape((*painted.shape[:2], 1))
        pixels = read_image(view.image).pixels
        if capture.hdr:
            write_exr(view.image, {"RGB": np.where(hit, painted, pixels).astype(np.float32)})
        else:
            write_png(view.image, np.where(hit, np.rint(255 * srgb(painted)), 255 * pixels).astype(np.uint8))
    return root


def trains(
    root: Path, out: Path, may_rest: frozenset[str] = frozenset(), steps: int = 100, solved: bool = False
) -> None:
    """Train so many steps per stage, and shade nearly every ray that may hit the object.

    Every field must change, except those in `may_rest`. The light is free, or fitted if `solved`.
    """
    config = small_config(
        sdf_steps=steps, material_steps=steps, joint_steps=steps, checkpoint_every=1000, rays=16
    )
    config = solved_light(config) if solved else config
    config = dataclasses.replace(config, shading=dataclasses.replace(config.shading, hit_share=0.01))
    training = small_training(root, out, config)
    groups = training.model.parameter_groups()
    before = {field: [p.detach().clone() for p in parameters] for field, parameters in groups.items()}
    with short_light_fits():
        train(training)
    assert training.skipped == 0, training.reporter.said
    assert len(training.reporter.losses) == 3 * steps
    for field, parameters in groups.items():
        assert all(p.isfinite().all() for p in parameters), field
        moved = not all(map(torch.equal, before[field], parameters))
        assert moved or field in may_rest, f"{field} did not train"
    assert all(b.isfinite().all() for b in training.model.buffers())


def environment(direction: np.ndarray) -> np.ndarray:
    """A bright lamp of about one pixel in a dim coloured sky."""
    lamp = np.exp(200.0 * (direction @ np.array([0.48, 0.6, 0.64]) - 1.0))
    return 50.0 * lamp[:, None] + 0.2 * (1.1 + direction)


def mirror(normal: np.ndarray, seen_along: np.ndarray) -> np.ndarray:
    """The mirrored environment."""
    return environment(seen_along - 2.0 * (seen_along * normal).sum(-1, keepdims=True) * normal)


def test_a_perfect_mirror(tmp_path):
    root = repaint(make_capture(tmp_path / "mirror", masks=True), mirror)
    assert max(read_image(view.image).pixels.max() for view in load_capture(root).views) > 10.0
    trains(root, tmp_path / "run")


def test_a_body_that_is_nearly_black(tmp_path):
    """It reflects at most a millionth of the surrounding light, and 10⁻¹¹ where it faces away."""
    root = repaint(make_capture(tmp_path / "dark", background=0.5), lambda n, d: 1e-6 * np.exp(6.0 * n - 6.0))
    trains(root, tmp_path / "run")


@pytest.mark.parametrize("hdr", [True, False])
def test_a_body_that_is_black_is_refused(tmp_path, hdr):
    """For an object that reflects nothing, neither material nor light can be determined."""
    root = make_capture(tmp_path / "black", background=0.5, masks=True, hdr=hdr)
    repaint(root, lambda n, d: np.zeros_like(n))
    with pytest.raises(UserError, match="all pixels of the object are black"):
        small_training(root, tmp_path / "run", small_config())


def test_an_overexposed_capture(tmp_path):
    root = make_capture(tmp_path / "burnt", hdr=False)
    repaint(
        root, lambda n, d: 0.5 + 40.0 * (n @ np.array([0.0, 0.6, 0.8]) + 0.7).clip(0.0)[:, None] * np.ones(3)
    )
    pixels = small_training(root, tmp_path / "unused", small_config()).pixels
    batch = pixels.view(1)
    assert (batch.color[batch.mask > 0.5] == 1.0).float().mean() > 0.5
    trains(root, tmp_path / "run")


def test_a_scene_without_an_object(tmp_path):
    root = make_capture(tmp_path / "empty", background=0.3)
    repaint(root, lambda n, d: np.full_like(n, 0.3))
    # If no surface is left, nothing is shaded.
    trains(root, tmp_path / "run", may_rest=frozenset({"brdf", "light"}))


# -------------------------------------------------------------------- captures that no setting was chosen for

# A fitted map is not a parameter, so no part of the light is trained by gradient steps.
odd = {"steps": 12, "solved": True, "may_rest": frozenset({"light"})}


def test_a_mirror_under_a_fitted_light(tmp_path):
    trains(repaint(make_capture(tmp_path / "mirror", masks=True), mirror), tmp_path / "run", **odd)


def test_one_view_to_train_on(tmp_path):
    root = make_capture(tmp_path / "one", views=2)
    assert len(load_capture(root).train_views) == 1
    trains(root, tmp_path / "run", **odd)


def test_masks_that_cover_everything(tmp_path):
    root = make_capture(tmp_path / "all", masks=True)
    for mask in (root / "inputs" / "masks").iterdir():
        write_png(mask, np.full((18, 24), 255, np.uint8))
    trains(root, tmp_path / "run", **odd)


def test_views_of_several_sizes(tmp_path):
    root, larger = make_capture(tmp_path / "capture"), make_capture(tmp_path / "larger", size=(37, 29))
    scenes = [json.loads((folder / "inputs" / "sfm_scene.json").read_text()) for folder in (root, larger)]
    tracks = [scene["camera_track_map"]["images"] for scene in scenes]
    for k in (1, 3):
        tracks[0][str(k)] = tracks[1][str(k)]
        for name in (f"images/{k:03d}.exr", f"depth_maps/{k:03d}.exr", f"normal_maps/{k:03d}.exr"):
            (root / "inputs" / name).write_bytes((larger / "inputs" / name).read_bytes())
    (root / "inputs" / "sfm_scene.json").write_text(json.dumps(scenes[0]))
    assert {view.camera.width for view in load_capture(root).views} == {24, 37}
    trains(root, tmp_path / "run", **odd)


@pytest.mark.parametrize("solved", [False, True])
def test_cameras_inside_the_object(tmp_path, solved):
    """In every direction there is a wall; its outside, which is the shaded side, is not visible."""
    root = make_capture(tmp_path / "inside", background=0.4)
    path = root / "inputs" / "sfm_scene.json"
    scene = json.loads(path.read_text())
    for k, track in scene["camera_track_map"]["images"].items():
        w2c = np.reshape(track["camera"]["extrinsic"], (4, 4))
        eye = CENTER - 0.2 * RADIUS * w2c[2, :3]
        w2c[:3, 3] = -w2c[:3, :3] @ eye
        track["camera"]["extrinsic"] = w2c.tolist()
        image = root / "inputs" / "images" / f"{int(k):03d}.exr"
        write_exr(image, {"RGB": np.full((18, 24, 3), 0.4, np.float32)})
    path.write_text(json.dumps(scene))
    trains(root, tmp_path / "run", may_rest=frozenset({"brdf", "light"}), steps=12, solved=solved)
