"""The exported mesh compared with the closed forms of a sphere."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from skimage.measure import marching_cubes

from neilfpp_method.data.capture import load_capture
from neilfpp_method.errors import UserError
from neilfpp_method.export.extract import extract_mesh
from neilfpp_method.export.mesh import export_mesh
from neilfpp_method.model import NeilfModel
from neilfpp_method.settings.facts import SceneFacts
from neilfpp_method.structures import Material, RayBatch, SurfaceHits
from neilfpp_method.train.run import Run
from tests.data.make_capture import CENTER, SCALE, make_capture, srgb
from tests.scenes import tiny_config

RADIUS = 0.6


def sphere(x: torch.Tensor) -> torch.Tensor:
    return x.norm(dim=-1) - RADIUS


def test_sphere_has_its_radius_volume_and_outward_faces():
    mesh = extract_mesh(sphere, radius=1.0, resolution=64)
    step = 2.0 / 63
    distance = np.linalg.norm(mesh.vertices, axis=-1)
    # A vertex lies on a chord of the distance along one edge: off by at most step² / (8 r) = 2.1e-4.
    np.testing.assert_allclose(distance, RADIUS, atol=step**2 / (8 * RADIUS) + 1e-6)
    # Chords remove a shell of that thickness, 3 · 2.1e-4 / 0.6 = 0.1 % of the volume; faces remove as much.
    assert mesh.volume == pytest.approx(4.0 / 3.0 * np.pi * RADIUS**3, rel=3e-3)
    assert mesh.is_watertight
    cosines = (mesh.vertex_normals * mesh.vertices).sum(-1) / distance
    assert cosines.min() > 0.98
    assert ((mesh.face_normals * mesh.triangles_center).sum(-1) > 0).all()


def test_few_points_are_evaluated_and_no_surface_is_lost():
    asked = []

    def counted(x: torch.Tensor) -> torch.Tensor:
        asked.append(len(x))
        # Two balls and a plane that leaves the sphere of the scene: a field with edges, of slope 1.
        balls = torch.minimum(x.norm(dim=-1) - 0.3, (x - torch.tensor([0.0, 0.5, 0.0])).norm(dim=-1) - 0.1)
        return torch.minimum(balls, x[:, 2] + 0.35)

    mesh = extract_mesh(counted, radius=1.0, resolution=128, chunk=50_000)
    assert max(asked) <= 50_000
    assert sum(asked) < 128**3 / 3
    # The reference evaluates every point. It keeps the faces within the sphere, as the mesh does.
    axis = torch.linspace(-1.0, 1.0, 128)
    dense = counted(torch.cartesian_prod(axis, axis, axis)).reshape(128, 128, 128).numpy()
    vertices, faces, _, _ = marching_cubes(dense, 0.0, allow_degenerate=False)
    vertices = vertices * (2.0 / 127) - 1.0
    inside = np.linalg.norm(vertices, axis=-1) <= 1.0
    whole = trimesh.Trimesh(vertices, faces[inside[faces].all(-1)], process=False)
    assert len(mesh.faces) == len(whole.faces)
    assert mesh.area == pytest.approx(whole.area, rel=1e-5)
    assert mesh.bounds == pytest.approx(whole.bounds, abs=1e-5)


def test_steep_field_keeps_its_surface():
    mesh = extract_mesh(lambda x: 1.25 * sphere(x), radius=1.0, resolution=64)
    assert mesh.is_watertight


@pytest.mark.parametrize("value", [1.0, -1.0, float("nan")])
def test_field_without_a_surface_is_an_error(value: float):
    with pytest.raises(UserError, match="no surface"):
        extract_mesh(lambda x: torch.full((len(x),), value), radius=1.0, resolution=16)


def test_surface_outside_the_scene_is_an_error():
    with pytest.raises(UserError, match="no surface"):
        # It lies only in the corners of the cube around the scene.
        extract_mesh(lambda x: 1.3 - x.norm(dim=-1), radius=1.0, resolution=32)


def test_a_grid_that_does_not_fit_in_memory_is_refused(monkeypatch):
    monkeypatch.setattr("neilfpp_method.data.memory.available_memory", lambda: 8 * 64**3 - 1)
    with pytest.raises(UserError, match=r"grid of 64³ points need about 0\.0 GB.*lower resolution"):
        extract_mesh(sphere, radius=1.0, resolution=64)
    extract_mesh(sphere, radius=1.0, resolution=56)


# ------------------------------------------------------------------------------------------------------ a run


class Ball(torch.nn.Module):
    """A host that is a sphere."""

    def render(self, rays: RayBatch) -> SurfaceHits:
        raise NotImplementedError

    def sdf(self, x: torch.Tensor) -> torch.Tensor:
        return sphere(x)


class Fog(torch.nn.Module):
    """A host without a distance field."""

    def render(self, rays: RayBatch) -> SurfaceHits:
        raise NotImplementedError


def make_run(folder: Path, host: torch.nn.Module, step: int) -> Run:
    config = tiny_config()
    model = NeilfModel(host, config, SceneFacts("linear", 0.2, 3.0, "constant")).eval()
    model.materials = lambda x: Material(0.5 + 0.5 * x, torch.ones(len(x), 1), torch.zeros(len(x), 1))
    return Run(folder, config, load_capture(make_capture(folder / "capture")), model.facts, model, step)


def test_export_is_in_the_frame_of_the_capture_with_colors(tmp_path: Path):
    run = make_run(tmp_path, Ball(), step=12)
    export_mesh(run, tmp_path / "mesh.ply", resolution=64)
    mesh = trimesh.load_mesh(tmp_path / "mesh.ply", process=False)
    from_center = mesh.vertices - CENTER
    distance = np.linalg.norm(from_center, axis=-1)
    # One scene unit is SCALE world units, and the scene's origin is CENTER.
    np.testing.assert_allclose(distance, SCALE * RADIUS, atol=2e-3)
    assert ((mesh.vertex_normals * from_center).sum(-1) / distance).min() > 0.98
    linear = 0.5 + 0.5 * from_center / SCALE
    np.testing.assert_allclose(mesh.visual.vertex_colors[:, :3], 255 * srgb(linear), atol=0.51)
    # Roughness is 1 throughout, metallic 0; other programs find both by their names.
    stored = mesh.metadata["_ply_raw"]["vertex"]["data"]
    assert (stored["roughness"] == 1).all()
    assert (stored["metallic"] == 0).all()
    assert {path.name for path in tmp_path.iterdir()} == {"capture", "mesh.ply"}


def test_export_keeps_vertices_at_map_coordinates(tmp_path: Path):
    run = make_run(tmp_path, Ball(), step=4)
    offset = np.array([5e6, 4e5, 0.0])
    moved = dataclasses.replace(
        run.capture.normalization, center=tuple(np.array(run.capture.normalization.center) + offset)
    )
    far = dataclasses.replace(run, capture=dataclasses.replace(run.capture, normalization=moved))
    export_mesh(run, tmp_path / "near.ply", resolution=32)
    export_mesh(far, tmp_path / "far.ply", resolution=32)
    near, far = (trimesh.load_mesh(tmp_path / f"{name}.ply", process=False) for name in ("near", "far"))
    np.testing.assert_allclose(far.vertices - offset, near.vertices, rtol=0, atol=1e-6)
    assert np.array_equal(far.faces, near.faces)


def test_export_before_the_material_stage_has_no_colors(tmp_path: Path):
    export_mesh(make_run(tmp_path, Ball(), step=4), tmp_path / "mesh.ply", resolution=32)
    assert trimesh.load_mesh(tmp_path / "mesh.ply").visual.kind is None


def test_export_needs_a_distance_field(tmp_path: Path):
    with pytest.raises(UserError, match="no distance field"):
        export_mesh(make_run(tmp_path, Fog(), step=4), tmp_path / "mesh.ply")
