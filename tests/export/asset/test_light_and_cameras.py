"""Environment maps, lamps and cameras as other programs interpret them."""

from __future__ import annotations

import json
import math
import sys
from dataclasses import replace
from importlib import resources
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.ndimage import binary_erosion

from neilfpp_method.data.cameras.projection import camera_rays, project
from neilfpp_method.data.files.images import read_image
from neilfpp_method.export.asset.environment import equirectangular
from neilfpp_method.fields.environment import EnvironmentLight
from neilfpp_method.structures import RayBatch
from neilfpp_method.train.run import Run
from tests.data.make_capture import CENTER, SCALE
from tests.export.asset.balls import BULB, PANEL, RADIUS, ball_run, material, write_ball
from tests.scenes import meet_ball


def blender_place(direction: np.ndarray) -> tuple[float, float]:
    """u from the left, v from the bottom: Cycles' `direction_to_equirectangular`, Z up."""
    x, y, z = direction
    return -math.atan2(y, x) / (2 * math.pi) + 0.5, math.atan2(z, math.hypot(x, y)) / math.pi + 0.5


def unreal_place(direction: np.ndarray) -> tuple[float, float]:
    """u from the left, v from the bottom. Unreal's Y is our −Y; its texture compressor turns Unreal's (X, Y,
    Z) into (X, Z, Y) and looks at u = (1 + atan2(x, −z)/π)/2, v from the top = acos(y)/π."""
    x, y, z = direction[0], direction[2], -direction[1]
    return (1 + math.atan2(x, -z) / math.pi) / 2, 1 - math.acos(y) / math.pi


@pytest.mark.parametrize(("program", "place"), [("blender", blender_place), ("unreal", unreal_place)])
@pytest.mark.parametrize("texel", [(3, 2), (5, 13), (1, 8)])
def test_a_bright_texel_is_where_the_program_expects_it(program, place, texel):
    row, column = texel
    radiance = torch.full((3, 9, 18), 0.1)
    radiance[:, row, column] = 5.0
    theta, phi = math.pi * row / 8, 2 * math.pi * (column + 0.5) / 18
    u, v = place(
        np.array([math.sin(phi) * math.sin(theta), math.cos(phi) * math.sin(theta), math.cos(theta)])
    )
    picture = equirectangular(radiance, program).numpy()
    height, width = picture.shape[:2]
    assert width == 2 * height
    brightest = np.unravel_index(picture[..., 0].argmax(), (height, width))
    assert abs(brightest[0] + 0.5 - (1 - v) * height) <= 1
    assert abs((brightest[1] + 0.5 - (u % 1) * width + width / 2) % width - width / 2) <= 1


@pytest.mark.parametrize("program", ["blender", "unreal"])
def test_the_map_has_the_same_radiance(program):
    """The mean over the sphere, and the radiance in all directions."""
    light = EnvironmentLight(9, 1.0)
    light.show(torch.rand(3, 9, 18, generator=torch.Generator().manual_seed(0)) + 0.1)
    picture = equirectangular(light.log_radiance.exp(), program).double().numpy()
    height, width = picture.shape[:2]
    weight = np.sin(np.pi * (np.arange(height) + 0.5) / height)[:, None, None]
    mean = (weight * picture).sum((0, 1)) / (weight.sum() * width)
    directions = torch.nn.functional.normalize(
        torch.randn(1, 200_000, 3, generator=torch.Generator().manual_seed(1)), dim=-1
    )
    shown = light.radiance(torch.zeros(1, 3), directions)[0]
    np.testing.assert_allclose(mean, shown.mean(0).numpy(), rtol=5e-3)


def test_a_fine_map_is_not_refined():
    assert equirectangular(torch.rand(3, 700, 1400), "blender").shape == (700, 1400, 3)
    assert equirectangular(torch.rand(3, 200, 400), "blender").shape == (512, 1024, 3)


# --------------------------------------------------------------------------------------- scenes, opened again


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Run:
    """With square pixels and the lobe that other renderers use."""
    run = ball_run(tmp_path_factory.mktemp("ball"), lobe="ggx")
    views = tuple(replace(view, camera=replace(view.camera, fy=view.camera.fx)) for view in run.capture.views)
    return replace(run, capture=replace(run.capture, views=views))


@pytest.fixture(scope="module")
def asset(run: Run) -> Path:
    write_ball(run, run.path / "asset", 512, faces=2000, resolution=128)
    return run.path / "asset"


def test_the_map_in_the_own_layout_is_included(run, asset):
    shown = read_image(asset / "environment.exr").pixels
    np.testing.assert_allclose(shown, run.model.light.log_radiance.exp().permute(1, 2, 0).numpy(), rtol=1e-6)
    for program in ("blender", "unreal"):
        stored = read_image(asset / f"environment_{program}.exr").pixels
        np.testing.assert_allclose(
            stored, equirectangular(run.model.light.log_radiance.exp(), program), rtol=1e-6
        )


def test_cameras_are_those_of_the_capture(run, asset):
    described = json.loads((asset / "scene.json").read_text())
    assert [camera["name"] for camera in described["cameras"]] == [view.name for view in run.capture.views]
    assert [camera["split"] for camera in described["cameras"]] == ["test"] + 7 * ["train"]
    for camera, view in zip(described["cameras"], run.capture.views, strict=True):
        rays = camera_rays(view.camera)
        column, row = 31, 7
        local = [
            (column + 0.5 - camera["cx"]) / camera["fx"],
            (row + 0.5 - camera["cy"]) / camera["fy"],
            1.0,
            0.0,
        ]
        pose = np.array(camera["camera_to_world"])
        direction = (pose @ local)[:3]
        pixel = row * camera["width"] + column
        np.testing.assert_allclose(direction / np.linalg.norm(direction), rays.directions[pixel], atol=1e-6)
        np.testing.assert_allclose(pose[:3, 3], rays.origins[pixel], atol=1e-6)
    np.testing.assert_allclose(described["lamps"][0]["position"], CENTER + SCALE * np.array(BULB), atol=1e-6)


@pytest.mark.parametrize("name", ["open_in_blender.py", "open_in_mitsuba.py"])
def test_scripts_compile_and_are_those_of_the_package(asset, name):
    text = (asset / name).read_text()
    compile(text, name, "exec")
    assert text == (resources.files("neilfpp_method.export.asset.scripts") / name).read_text()


def own_picture(run: Run, view: str) -> tuple[np.ndarray, np.ndarray]:
    """Image of the true sphere by the run's own rendering equation, (H, W, 3), and the pixels inside its
    outline, (H, W), that show no lamp.
    """
    camera = run.capture.normalization.camera(next(v.camera for v in run.capture.views if v.name == view))
    rays = camera_rays(camera)
    position, hit = meet_ball(RayBatch(rays.origins, rays.directions), RADIUS)
    rows = torch.nonzero(hit)[:, 0]
    normal, picture = position[rows] / RADIUS, torch.zeros(len(rays), 3)
    shading = run.model.shade(position[rows], normal, -rays.directions[rows], material(position[rows]), 2048)
    picture[rows] = shading.color
    lamps = project(camera, torch.tensor([BULB, PANEL], dtype=torch.float64)).pixel
    v, u = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
    apart = (torch.stack([u, v], dim=-1)[:, :, None] - lamps).norm(dim=-1).amin(dim=-1) > 3
    within = binary_erosion(hit.view(camera.height, camera.width).numpy() > 0) & apart.numpy()
    return picture.view(camera.height, camera.width, 3).numpy(), within


def test_mitsuba_agrees_with_the_run(run, asset, tmp_path, monkeypatch):
    """Another renderer with the exported script: cameras, textures, axes, the map and both lamps together."""
    pytest.importorskip("mitsuba")
    monkeypatch.syspath_prepend(str(asset))
    monkeypatch.delitem(sys.modules, "open_in_mitsuba", raising=False)
    import open_in_mitsuba

    out = tmp_path / "001.exr"
    monkeypatch.setattr(sys, "argv", ["open_in_mitsuba.py", str(out), "--camera", "001", "--samples", "64"])
    open_in_mitsuba.main()
    picture = read_image(out).pixels
    truth, within = own_picture(run, "001")
    assert within.sum() > 150
    # 31 dB: Mitsuba's diffuse lobe is Disney's, 4 % darker here. Without textures, or rotated by 90°, it
    # is 20 dB or less.
    error = np.square(picture - truth)[within].mean()
    assert -10 * math.log10(error) > 29
    np.testing.assert_allclose(picture[within].mean(0), truth[within].mean(0), rtol=0.08)
