"""Render an exported asset in Blender (bpy) and compare it with the package's path tracer; skipped without
bpy.

NEILFPP_BPY names a Python that has bpy. It is a separate environment, because bpy needs its own versions of
Python and NumPy.
"""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from scipy.ndimage import binary_erosion

from benchmarks.blender import Shot, blender_picture, shown_psnr
from neilfpp_method.errors import UserError
from neilfpp_method.relight.film import Budget, render_picture
from neilfpp_method.relight.path_tracer import Scene
from neilfpp_method.relight.sky import sky_of_run
from neilfpp_method.relight.surface import Surface
from neilfpp_method.shading.brdf import GGX
from neilfpp_method.structures import Material
from neilfpp_method.train.run import Run
from tests.export.asset.balls import RADIUS, ball_run, write_ball

VIEW = "001"


def rough_paint(x: torch.Tensor) -> Material:
    """A material without metal."""
    wave = 0.5 + 0.3 * torch.sin(3 * x)
    return Material(wave, torch.full_like(x[:, :1], 0.7), torch.zeros_like(x[:, :1]))


@pytest.fixture(scope="module")
def python() -> Path:
    """A Python that has bpy."""
    found = Path(os.environ.get("NEILFPP_BPY", sys.executable))
    if subprocess.run([found, "-c", "import bpy"], capture_output=True, check=False).returncode:
        pytest.skip("no bpy; NEILFPP_BPY names a Python that has it")
    return found


def painted_run(folder: Path) -> Run:
    """A ball of rough paint under a map with a sun, with the lobe and the square pixels that Blender has."""
    run = ball_run(folder, kind="distant", lobe="ggx")
    run.model.materials = rough_paint
    views = tuple(replace(view, camera=replace(view.camera, fy=view.camera.fx)) for view in run.capture.views)
    return replace(run, capture=replace(run.capture, views=views))


def own_picture(run: Run) -> tuple[np.ndarray, np.ndarray]:
    """Image of the true ball under the run's map by the package's path tracer, (H, W, 3), and the pixels of
    the ball, (H, W).
    """
    mesh = trimesh.creation.icosphere(subdivisions=5, radius=RADIUS)
    triangles = torch.tensor(np.array(mesh.triangles), dtype=torch.float32)
    surface = Surface(triangles, torch.nn.functional.normalize(triangles, dim=-1))
    camera = next(view.camera for view in run.capture.views if view.name == VIEW)
    scene = Scene(surface, rough_paint, GGX, sky_of_run(run.model.light))
    picture = render_picture(scene, run.capture.normalization.camera(camera), Budget(256), bounces=1)
    return picture.radiance.numpy(), binary_erosion(picture.alpha[..., 0].numpy() == 1)


@pytest.mark.slow
@pytest.mark.parametrize("source", ["glb", "usd"])
def test_blender_agrees_with_the_path_tracer(python, tmp_path, source):
    if source == "usd":
        pytest.importorskip("pxr")
    run = painted_run(tmp_path)
    write_ball(run, tmp_path / "asset", 512, faces=2000, resolution=128)
    picture = blender_picture(python, tmp_path / "asset", Shot(VIEW, source), tmp_path / "out.exr")
    truth, within = own_picture(run)
    assert within.sum() > 150
    assert shown_psnr(picture, truth, within) > 33
    # Cycles subtracts from the diffuse part what the coat reflects: 3 to 4 % here.
    np.testing.assert_allclose(picture[within].mean(0), truth[within].mean(0), rtol=0.06)
    # A rotated map, or colours that are decoded twice, would give a much lower PSNR.
    assert shown_psnr(np.roll(picture, 4, axis=1), truth, within) < 25


@pytest.mark.slow
def test_half_the_image_size(python, tmp_path):
    write_ball(painted_run(tmp_path), tmp_path / "asset", 64, faces=300)
    out = tmp_path / "out.exr"
    shot = Shot(VIEW, percent=50, samples=1)
    assert blender_picture(python, tmp_path / "asset", shot, out).shape == (18, 24, 3)


def test_a_python_without_bpy_is_an_error(tmp_path):
    write_ball(painted_run(tmp_path), tmp_path / "asset", 64, faces=300)
    (tmp_path / "asset" / "bpy.py").write_text("raise ImportError('no bpy here')\n")
    with pytest.raises(UserError, match="pip install bpy"):
        blender_picture(Path(sys.executable), tmp_path / "asset", Shot(VIEW), tmp_path / "out.exr")
