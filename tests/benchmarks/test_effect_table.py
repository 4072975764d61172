"""The table that compares decided with true effects, and the captures that it uses."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest

from benchmarks.effect_scenes import bowl, lambertian, write_capture
from benchmarks.effect_table import JUDGED, markdown, read_run
from benchmarks.mitsuba_scene import load_mitsuba
from neilfpp_method.data.capture import load_capture
from neilfpp_method.data.truth import Truth
from neilfpp_method.effects.catalogue import EFFECTS
from neilfpp_method.errors import UserError


def test_a_wrong_decision_is_marked_with_its_reason(tmp_path):
    on = {"inter-reflection", "environment-map", "reflection", "metals", "lobe-sampling"}
    rows = [
        {"effect": name, "decision": "on" if name in on else "off", "reason": f"why {name}"}
        for name in JUDGED
    ]
    (tmp_path / "effects.json").write_text(json.dumps({"effects": rows}))
    (tmp_path / "capture.json").write_text(json.dumps({"root": "scenes/bowl"}))
    lines = markdown([read_run(tmp_path)])
    assert lines[0] == "| effect | bowl |"
    assert "| metals | on (wrong) |" in lines
    assert "| coloured-light | off |" in lines
    assert lines[-1] == "- bowl, metals: why metals"
    assert set(JUDGED) <= set(EFFECTS)
    (tmp_path / "capture.json").write_text(json.dumps({"root": "scenes/teapot"}))
    with pytest.raises(UserError, match="nothing is known of teapot"):
        read_run(tmp_path)


def test_a_rendered_capture_shows_the_ball(tmp_path):
    """The ball of radius 0.8 at distance 3.4 is in the images, as bright as its paint under its sky."""
    pytest.importorskip("mitsuba")
    scene = dataclasses.replace(lambertian(), radiance=np.ones((8, 16, 3)))
    root = write_capture(load_mitsuba("scalar_rgb"), scene, tmp_path / "ball", 3, (12, 9), samples=16)
    capture = load_capture(root)
    view = capture.test_views[0]
    truth = Truth(capture)
    depth, material = truth.depth(view).view(9, 12), truth.material(view)
    assert depth[4, 6].item() == pytest.approx(2.6, abs=0.05)
    assert depth[0, 0] == 0
    assert material.roughness.view(9, 12)[4, 6] == 1
    assert len(capture.train_views) == 2


def test_the_bowl_is_closed_and_its_quarters_have_equal_size():
    areas = [part.mesh.area for part in bowl().parts]
    assert max(areas) == pytest.approx(min(areas), rel=1e-3)
