"""Unusual units: the unit of length or radiance of a capture changes neither surface nor material.

Factors are powers of two, which cause no rounding, so two trainings can be compared bit for bit.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch

from neilfpp_method.data.capture import load_capture
from neilfpp_method.data.files.images import read_image, write_exr
from neilfpp_method.data.pixels.dataset import PixelDataset
from neilfpp_method.data.point_cloud import read_oriented_ply, write_oriented_ply
from neilfpp_method.settings.types import NeilfConfig
from neilfpp_method.train.loop import train
from neilfpp_method.train.training import Training
from tests.data.make_capture import make_capture
from tests.train.small_runs import short_light_fits, small_config, small_training, solved_light

pytestmark = pytest.mark.usefixtures("without_shape_checks")

STEPS = 4


def settings(light: str) -> NeilfConfig:
    config = small_config(sdf_steps=STEPS, material_steps=STEPS, joint_steps=STEPS)
    return config if light == "free" else solved_light(config)


def trained(folder: Path, light: str, radiance: float = 1.0, length: float = 1.0) -> Training:
    """A few steps of each stage on the sphere, its images and its world in other units."""
    root = make_capture(folder / "capture", masks=True, background=0.1)
    for image in (root / "inputs" / "images").iterdir():
        write_exr(image, {"RGB": read_image(image).pixels * np.float32(radiance)})
    path = root / "inputs" / "sfm_scene.json"
    scene = json.loads(path.read_text())
    for track in scene["camera_track_map"]["images"].values():
        w2c = np.reshape(track["camera"]["extrinsic"], (4, 4))
        w2c[:3, 3] *= length
        track["camera"]["extrinsic"] = w2c.tolist()
    box = np.reshape(scene["bbox"]["transform"], (4, 4))
    box[:3] *= length
    scene["bbox"]["transform"] = box.tolist()
    path.write_text(json.dumps(scene))
    cloud = root / "inputs" / "model" / "oriented_pcd.ply"
    if cloud.exists():
        points = read_oriented_ply(cloud)
        write_oriented_ply(cloud, dataclasses.replace(points, position=points.position * length))
    run = small_training(root, folder / "run", settings(light))
    with short_light_fits():
        train(run)
    assert run.skipped == 0
    run.model.eval()
    return run


@pytest.fixture(scope="module", params=["free", "auto"])
def usual(request, without_shape_checks, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Training]:
    return request.param, trained(tmp_path_factory.mktemp("usual"), request.param)


@pytest.mark.parametrize(("radiance", "length"), [(2.0**13, 2.0**-10), (2.0**-13, 2.0**10)])
def test_other_units_give_the_same_scene(tmp_path, usual, radiance, length):
    """Surface and material are the same; the light and R have the unit of the images."""
    light, reference = usual
    other = trained(tmp_path, light, radiance, length)
    # The logarithm of a map's texels is shifted by the unit, and rounded.
    tolerance = {"rtol": 0.0, "atol": 0.0} if light == "free" else {"rtol": 1e-3, "atol": 1e-4}
    for field in ("geometry", "brdf"):
        groups = (run.model.parameter_groups()[field] for run in (reference, other))
        for p, q in zip(*groups, strict=True):
            torch.testing.assert_close(q, p, **tolerance)

    x, wi = torch.tensor([[0.0, 0.0, 0.8]]), torch.tensor([[[0.0, 0.6, 0.8], [1.0, 0.0, 0.0]]])
    rays = reference.pixels.view(0).rays
    with torch.no_grad():
        for shown in (lambda model: model.light.radiance(x, wi), lambda model: model.host.render(rays).color):
            expected = radiance * shown(reference.model)
            torch.testing.assert_close(
                shown(other.model), expected, rtol=1e-3, atol=1e-4 * float(expected.mean())
            )


@pytest.mark.parametrize("length", [1e-4, 1e4])
def test_a_scene_in_other_units_and_far_from_the_origin_has_the_same_rays(tmp_path, length):
    """A world frame whose unit is 10⁴ times larger or smaller, and whose origin is 10⁴ radii away."""
    away = 1e4 * np.array([0.6, 0.0, -0.8])
    usual, other = make_capture(tmp_path / "usual"), make_capture(tmp_path / "other")
    path = other / "inputs" / "sfm_scene.json"
    scene = json.loads(path.read_text())
    for track in scene["camera_track_map"]["images"].values():
        w2c = np.reshape(track["camera"]["extrinsic"], (4, 4))
        w2c[:3, 3] = length * (w2c[:3, 3] - w2c[:3, :3] @ away)
        track["camera"]["extrinsic"] = w2c.tolist()
    box = np.reshape(scene["bbox"]["transform"], (4, 4))
    box[:3] *= length
    box[:3, 3] += length * away
    scene["bbox"]["transform"] = box.tolist()
    path.write_text(json.dumps(scene))
    one, two = (
        PixelDataset(capture, capture.views).sample(2000)
        for capture in map(load_capture, (usual, other))
        if torch.manual_seed(0)
    )
    torch.testing.assert_close(two.origins, one.origins, rtol=0, atol=1e-6)
    torch.testing.assert_close(two.directions, one.directions, rtol=0, atol=1e-6)
    assert torch.equal(two.color, one.color)
