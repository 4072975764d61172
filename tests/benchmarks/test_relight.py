"""Compare the path tracer with Mitsuba, an independent implementation; skipped if Mitsuba is not
installed.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from benchmarks import relight
from benchmarks.mitsuba_scene import LitScene, PathSampling, load_mitsuba, render
from neilfpp_method.errors import UserError
from neilfpp_method.relight.film import Budget, render_picture
from neilfpp_method.relight.sky import Sky


def test_an_image_of_the_corner_agrees_with_mitsuba(tmp_path):
    """Under a smooth, rotated sky. A wrong axis or a missing bounce would change every pixel by tenths."""
    pytest.importorskip("mitsuba")
    mi = load_mitsuba("scalar_rgb")
    radiance = relight.sunny_map(8).clamp_max(1.2)
    radiance[:, 8:] *= 0.2  # from the left, where x is below 0, comes little
    camera = relight.corner_camera(12)
    scene = relight.scene_of(relight.corner_parts(), Sky(radiance, rows_at_poles=True, start=0.0))
    ours = render_picture(scene, camera, Budget(256), bounces=3).radiance.numpy()
    lit = LitScene(relight.corner_parts(), radiance.numpy())
    theirs = render(mi, lit, camera, PathSampling(64, bounces=3, seed=1), tmp_path)
    mean = theirs.mean()
    assert ours.mean() == pytest.approx(mean, rel=0.015)
    assert np.abs(ours - theirs).mean() < 0.1 * mean
    turned = dataclasses.replace(scene, sky=Sky(radiance, rows_at_poles=True, start=1.5))
    other = render_picture(turned, camera, Budget(64), bounces=3).radiance.numpy()
    assert np.abs(other - theirs).mean() > 0.2 * mean


def test_without_mitsuba_there_is_an_error(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "mitsuba", None)
    with pytest.raises(UserError, match="pip install mitsuba"):
        load_mitsuba("scalar_rgb")
