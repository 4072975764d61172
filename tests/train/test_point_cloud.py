"""The capture's point cloud supervises the geometry, if there is one."""

from __future__ import annotations

import dataclasses

import pytest

from neilfpp_method.data.capture import load_capture
from neilfpp_method.data.pixels.dataset import PixelDataset
from neilfpp_method.schedule import Stage
from neilfpp_method.settings.plain import changed
from neilfpp_method.settings.presets import fixed_geometry, preset
from neilfpp_method.train.build import build_model, cloud_summary, scene_facts
from tests.data.make_capture import make_capture
from tests.scenes import tiny_config


@pytest.fixture
def capture(tmp_path):
    return load_capture(make_capture(tmp_path / "sphere"))


def built(capture, config):
    pixels = PixelDataset(capture, capture.train_views)
    return build_model(capture, scene_facts(capture, pixels, config), config), pixels


def test_the_cloud_is_in_the_loss_of_fast(capture):
    config = preset("fast")
    weight = config.host.loss.point_cloud
    assert weight > 0
    model, pixels = built(capture, changed(tiny_config(), {"host.loss.point_cloud": weight}))
    terms = model.losses(pixels.sample(8), Stage.SDF_INIT)
    # The initial sphere does not have the radius 0.8, so the points are not on it.
    assert terms["point_cloud"].values.max() > 0.05
    assert "oriented_pcd.ply supervises the geometry" in cloud_summary(capture, config)


def test_a_capture_without_a_cloud_has_no_loss_on_it(capture):
    without = dataclasses.replace(capture, point_cloud=None)
    config = changed(tiny_config(), {"host.loss.point_cloud": 0.1})
    model, pixels = built(without, config)
    assert "point_cloud" not in model.losses(pixels.sample(8), Stage.SDF_INIT)
    assert f"neilfpp prepare {without.root} --out CAPTURE" in cloud_summary(without, config)


def test_no_message_if_the_settings_use_no_cloud(capture):
    assert cloud_summary(capture, changed(preset("fast"), {"host.loss.point_cloud": 0.0})) is None
    assert cloud_summary(capture, fixed_geometry(preset("fast"))) is None
