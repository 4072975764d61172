"""Scenes that strain the method: a hundred steps of each stage end finite, and none is skipped."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from neilfpp_method.data.capture import load_capture
from neilfpp_method.data.images import read_image, write_exr, write_png
from neilfpp_method.data.views import camera_rays
from neilfpp_method.errors import UserError
from neilfpp_method.train.loop import train
from tests.data.make_capture import RADIUS, SCALE, make_capture, srgb
from tests.train.small_runs import small_config, small_training

pytestmark = pytest.mark.usefixtures("without_shape_checks")

# Linear radiance from a unit normal and the unit direction of the ray that sees it, both of the scene frame.
Look = Callable[[np.ndarray, np.ndarray], np.ndarray]


def repaint(root: Path, look: Look) -> Path:
    """Paint the sphere of a capture anew; what lies beside it stays."""
    capture = load_capture(root)
    radius = RADIUS / SCALE
    for view in capture.views:
        rays = camera_rays(capture.normalisation.camera(view.camera))
        o, d = rays.origins.double().numpy(), rays.directions.double().numpy()
        # |o + t d|² = r²
        b = (o * d).sum(-1)
        under_root = b**2 - (o**2).sum(-1) + radius**2
        hit = under_root > 0
        normal = (o + (-b - np.sqrt(under_root.clip(0)))[:, None] * d) / radius
        painted = np.where(hit[:, None], look(normal, d), 0.0).reshape(view.camera.height, view.camera.width, 3)
        hit = hit.reshape((*painted.shape[:2], 1))
        pixels = read_image(view.image).pixels
        if capture.hdr:
            write_exr(view.image, {"RGB": np.where(hit, painted, pixels).astype(np.float32)})
        else:
            write_png(view.image, np.where(hit, np.rint(255 * srgb(painted)), 255 * pixels).astype(np.uint8))
    return root


def trains(root: Path, out: Path, may_rest: frozenset[str] = frozenset()) -> None:
    """Train a hundred steps a stage, and shade nearly every ray that the object might stop.

    Every field must move, but those that `may_rest`.
    """
    config = small_config(sdf_steps=100, material_steps=100, joint_steps=100, checkpoint_every=1000, rays=16)
    config = dataclasses.replace(config, shading=dataclasses.replace(config.shading, hit_share=0.01))
    training = small_training(root, out, config)
    groups = training.model.parameter_groups()
    before = {field: [p.detach().clone() for p in parameters] for field, parameters in groups.items()}
    train(training)
    assert training.skipped == 0, training.reporter.said
    assert len(training.reporter.losses) == 300
    for field, parameters in groups.items():
        assert all(p.isfinite().all() for p in parameters), field
        moved = not all(map(torch.equal, before[field], parameters))
        assert moved or field in may_rest, f"{field} did not train"


def environment(direction: np.ndarray) -> np.ndarray:
    """A bright lamp, as sharp as a pixel or so, in a dim coloured sky."""
    lamp = np.exp(200.0 * (direction @ np.array([0.48, 0.6, 0.64]) - 1.0))
    return 50.0 * lamp[:, None] + 0.2 * (1.1 + direction)


def test_a_perfect_mirror(tmp_path):
    def mirror(normal: np.ndarray, seen_along: np.ndarray) -> np.ndarray:
        return environment(seen_along - 2.0 * (seen_along * normal).sum(-1, keepdims=True) * normal)

    root = repaint(make_capture(tmp_path / "mirror", masks=True), mirror)
    assert max(read_image(view.image).pixels.max() for view in load_capture(root).views) > 10.0
    trains(root, tmp_path / "run")


def test_a_body_that_is_nearly_black(tmp_path):
    """At most a millionth of the light about it, and 10⁻¹¹ where it faces away."""
    root = repaint(make_capture(tmp_path / "dark", background=0.5), lambda n, d: 1e-6 * np.exp(6.0 * n - 6.0))
    trains(root, tmp_path / "run")


@pytest.mark.parametrize("hdr", [True, False])
def test_a_body_that_is_black_is_refused(tmp_path, hdr):
    """Of an object that reflects nothing neither material nor light can be told."""
    root = make_capture(tmp_path / "black", background=0.5, masks=True, hdr=hdr)
    repaint(root, lambda n, d: np.zeros_like(n))
    with pytest.raises(UserError, match="all pixels of the object are black"):
        small_training(root, tmp_path / "run", small_config())


def test_an_overexposed_capture(tmp_path):
    root = make_capture(tmp_path / "burnt", hdr=False)
    repaint(root, lambda n, d: 0.5 + 40.0 * (n @ np.array([0.0, 0.6, 0.8]) + 0.7).clip(0.0)[:, None] * np.ones(3))
    pixels = small_training(root, tmp_path / "unused", small_config()).pixels
    batch = pixels.view(1)
    assert (batch.color[batch.mask > 0.5] == 1.0).float().mean() > 0.5
    trains(root, tmp_path / "run")


def test_a_scene_without_an_object(tmp_path):
    root = make_capture(tmp_path / "empty", background=0.3)
    repaint(root, lambda n, d: np.full_like(n, 0.3))
    # Once nothing is left to hit, there is nothing to shade.
    trains(root, tmp_path / "run", may_rest=frozenset({"brdf", "light"}))
