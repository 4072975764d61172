"""A mesh as the host: first hits, rendered values, and the light between surfaces."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from torch.nn.functional import normalize

from neilfpp_method.cli import main
from neilfpp_method.data.mesh import Mesh
from neilfpp_method.errors import UserError
from neilfpp_method.hosts import mesh_tracing
from neilfpp_method.hosts.mesh import MeshHost
from neilfpp_method.hosts.mesh_tracing import build_tree, embree_tracer, tree_tracer
from neilfpp_method.incident.traced import trace_light
from neilfpp_method.model import NeilfModel
from neilfpp_method.schedule import Stage, active_losses, weigh
from neilfpp_method.settings.facts import SceneFacts
from neilfpp_method.settings.presets import PRESETS, fixed_geometry
from neilfpp_method.settings.types import NeilfConfig
from neilfpp_method.structures import RayBatch
from tests.calls import refused
from tests.data.make_capture import CENTER, make_capture
from tests.scenes import sphere_batch, tiny_config
from tests.train.small_runs import small_config


def mesh_of(shape: trimesh.Trimesh) -> Mesh:
    vertices = torch.as_tensor(np.array(shape.vertices), dtype=torch.float32)
    return Mesh(vertices, torch.as_tensor(np.array(shape.faces), dtype=torch.int64))


def mesh_config(**changes) -> NeilfConfig:
    return dataclasses.replace(fixed_geometry(tiny_config()), **changes)


def mesh_facts() -> SceneFacts:
    return SceneFacts("linear", 0.2, 3.0, "constant", background_color=(0.25, 0.5, 0.75))


def mesh_host(shape: trimesh.Trimesh, **changes) -> MeshHost:
    torch.manual_seed(0)
    return MeshHost(mesh_of(shape), mesh_config(**changes), mesh_facts())


def rays_at(count: int, spread: float, seed: int = 0, dtype: torch.dtype = torch.float32) -> RayBatch:
    """Rays from all sides, from a distance of 3 units, to points around the origin."""
    generator = torch.Generator().manual_seed(seed)
    origins = 3.0 * normalize(torch.randn(count, 3, generator=generator, dtype=dtype), dim=-1)
    targets = spread * (2.0 * torch.rand(count, 3, generator=generator, dtype=dtype) - 1.0)
    return RayBatch(origins, normalize(targets - origins, dim=-1))


SPHERE = trimesh.creation.icosphere(subdivisions=5, radius=0.7)


@pytest.fixture(params=["embree", "tree"])
def tracer(request, monkeypatch) -> str:
    """Both implementations of first hits."""
    if request.param == "tree":
        monkeypatch.setattr("neilfpp_method.hosts.mesh_tracing.embree_tracer", lambda triangles: None)
    return request.param


# --------------------------------------------------------------------------------------------------- geometry


def test_hits_on_a_sphere_are_accurate(tracer):
    rays = rays_at(2000, 0.6)
    hits = mesh_host(SPHERE).render(rays)
    along = (rays.origins * rays.directions).sum(-1)
    beside = (rays.origins.square().sum(-1) - along**2).sqrt()  # distance of the ray from the centre
    assert torch.equal(hits.opacity > 0, hits.concentration > 0)
    assert (hits.opacity[beside < 0.699] == 1.0).all()
    assert (hits.opacity[beside > 0.7] == 0.0).all()
    clear = beside < 0.65
    depth = -along - (0.49 - beside**2).clamp_min(0.0).sqrt()
    position = rays.origins + depth[:, None] * rays.directions
    torch.testing.assert_close(hits.position[clear], position[clear], atol=2e-3, rtol=0.0)
    torch.testing.assert_close(hits.normal[clear], position[clear] / 0.7, atol=5e-3, rtol=0.0)


def test_hits_on_a_box_are_exact(tracer):
    half = torch.tensor([0.3, 0.4, 0.5], dtype=torch.float64)
    host = mesh_host(trimesh.creation.box(extents=(0.6, 0.8, 1.0))).double()
    rays = rays_at(2000, 0.7, dtype=torch.float64)
    enter = ((-rays.directions.sign() * half - rays.origins) / rays.directions).max(dim=-1)
    leave = ((rays.directions.sign() * half - rays.origins) / rays.directions).amin(dim=-1)
    meets = enter.values < leave
    hits = host.render(rays)
    assert torch.equal(hits.opacity.bool(), meets)
    depth = ((hits.position - rays.origins) * rays.directions).sum(-1)
    torch.testing.assert_close(depth[meets], enter.values[meets], atol=1e-6, rtol=0.0)
    axis = torch.nn.functional.one_hot(enter.indices, 3) * -rays.directions.sign()
    torch.testing.assert_close(hits.normal[meets], axis[meets], atol=1e-6, rtol=0.0)


def test_a_miss_has_the_background_color_and_no_normal(tracer):
    hits = mesh_host(SPHERE).render(RayBatch(3.0 * torch.eye(3), torch.eye(3)))
    torch.testing.assert_close(hits.color, torch.tensor([[0.25, 0.5, 0.75]]).expand(3, 3))
    assert not hits.normal.any()
    assert not hits.concentration.any()


def test_an_open_background_is_rendered_behind_the_mesh():
    torch.manual_seed(0)
    host = MeshHost(mesh_of(SPHERE), mesh_config(), SceneFacts("linear", 0.2, 3.0, "inverted_sphere"))
    rays = rays_at(100, 0.9)
    hits = host.render(rays)
    beyond = host.background(rays.origins, rays.directions)
    missed = hits.opacity == 0.0
    assert 0 < missed.sum() < 100
    torch.testing.assert_close(hits.color[missed], beyond[missed])
    assert (hits.color[~missed] != beyond[~missed]).all()
    assert set(host.parameter_groups()) == {"radiance", "background"}


def test_no_normal_points_away_from_the_viewer():
    rays = rays_at(2000, 0.8)
    ball = trimesh.creation.icosphere(subdivisions=1, radius=0.7)
    hits = mesh_host(ball).render(rays)
    seen = hits.concentration > 0
    assert ((hits.normal * rays.directions).sum(-1)[seen] < 0.0).all()
    torch.testing.assert_close(hits.normal[seen].norm(dim=-1), torch.ones(int(seen.sum())))
    distinct = hits.normal[seen].mul(1e4).round().unique(dim=0)
    assert len(distinct) > 80  # triangles


def test_normals_are_smooth_except_at_creases():
    """A cylinder with lids: the vertices of its rim are shared by side and lids."""
    can = trimesh.creation.cylinder(radius=0.5, height=0.8, sections=48)
    rays = rays_at(4000, 0.8)
    hits = mesh_host(can).render(rays)
    seen = hits.concentration > 0
    position, normal = hits.position[seen], hits.normal[seen]
    lid = position[:, 2].abs() > 0.3999
    flat = torch.nn.functional.pad(position[lid][:, 2:].sign(), (2, 0))
    torch.testing.assert_close(normal[lid], flat, atol=1e-5, rtol=0.0)
    round_ = torch.nn.functional.normalize(position[~lid] * position.new_tensor([1.0, 1.0, 0.0]), dim=-1)
    assert min(lid.sum(), (~lid).sum()) > 100
    # Between the vertices of 48 sides the normal of a chord deviates by at most 3.75°, an interpolated one by
    # far less.
    assert (normal[~lid] * round_).sum(-1).min() > math.cos(math.radians(0.1))


def test_a_face_without_area_has_no_normal_and_affects_no_other():
    box = trimesh.creation.box(extents=(0.8, 0.8, 0.8))
    line = [[0, 1, 1], [0, 0, 0]]
    shape = trimesh.Trimesh(box.vertices, np.concatenate([box.faces, line]), process=False)
    rays = rays_at(500, 0.5)
    torch.testing.assert_close(mesh_host(shape).render(rays).normal, mesh_host(box).render(rays).normal)


def test_the_inside_of_a_face_stops_a_ray_and_is_not_a_hit(tracer):
    hits = mesh_host(SPHERE).render(RayBatch(torch.zeros(3, 3), torch.eye(3)))
    torch.testing.assert_close(hits.position, 0.7 * torch.eye(3), atol=1e-3, rtol=0.0)  # ahead, not behind
    assert (hits.opacity == 1.0).all()
    assert not hits.is_hit(0.8).any()


def test_the_tree_agrees_with_embree(monkeypatch):
    knot = trimesh.creation.torus(0.5, 0.2, major_sections=90, minor_sections=40)
    floor = trimesh.creation.box(
        extents=(2.0, 2.0, 0.0)
    )  # large triangles beside small ones, and two of them flat
    shape = trimesh.util.concatenate([knot, floor, trimesh.creation.icosphere(subdivisions=4, radius=0.2)])
    triangles = torch.as_tensor(np.array(shape.triangles), dtype=torch.float32)
    monkeypatch.setattr(mesh_tracing, "RAYS_AT_ONCE", 1000)
    tree, embree = tree_tracer(build_tree(triangles)), embree_tracer(triangles)
    rays = rays_at(2500, 0.9)
    found, expected = (t(rays.origins, rays.directions) for t in (tree, embree))
    assert 0.3 < (expected >= 0).float().mean() < 1.0
    # Two triangles share an edge, and the floor consists of two coincident sheets, so the distance decides
    # nothing.
    same = found == expected
    depths = [
        mesh_tracing.intersect_planes(rays.origins, rays.directions, triangles[t]).distance
        for t in (found, expected)
    ]
    assert ((depths[0] - depths[1]).abs()[~same] < 1e-5).all()
    assert torch.equal(found >= 0, expected >= 0)
    assert same.float().mean() > 0.7


@pytest.mark.parametrize("faces", [1, 7, 8, 9, 65])
def test_a_tree_contains_every_triangle(faces):
    corners = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    shift = 2.0 * torch.arange(faces)[:, None] * torch.tensor([1.0, 0.0, 0.0])
    tracer = tree_tracer(build_tree(corners + shift[:, None]))
    origins = shift + torch.tensor([0.25, 0.25, 1.0])
    down = torch.tensor([[0.0, 0.0, -1.0]]).expand(faces, 3)
    assert torch.equal(tracer(origins, down), torch.arange(faces))
    assert (tracer(origins, -down) == -1).all()  # away from them


def test_a_ray_between_two_triangles_hits_the_one_ahead():
    corners = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    tracer = tree_tracer(build_tree(torch.stack([corners, corners + torch.tensor([0.0, 0.0, 1.0])])))
    up = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    assert tracer(torch.tensor([[0.2, 0.2, 0.4]]).expand(2, 3), up).tolist() == [1, 0]


# ---------------------------------------------------------------------------------------------- light between


def two_planes() -> trimesh.Trimesh:
    """A floor at z = 0 that faces up, and a ceiling at z = 0.5 that faces down."""
    corners = [[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]]
    ceiling = [[x, y, 0.5] for x, y, _ in corners]
    return trimesh.Trimesh(corners + ceiling, [[0, 1, 2], [0, 2, 3], [4, 6, 5], [4, 7, 6]], process=False)


def with_rays_per_point(count: float) -> NeilfConfig:
    return mesh_config(light=dataclasses.replace(mesh_config().light, rays_per_point=count))


def test_light_between_two_planes_is_their_emission():
    """The ceiling emits 1 + x, the floor 3 + y; a ray from the floor's centre hits the ceiling at a distance
    0.5 tan θ from the axis.
    """
    host = mesh_host(two_planes())
    host.radiance_field.forward = lambda x, wo, n, f: torch.where(
        n[:, 2:] < 0, 1.0 + x[:, :1], 3.0 + x[:, 1:2]
    ).expand(-1, 3)
    floor, up = torch.zeros(4000, 3), torch.tensor([[0.0, 0.0, 1.0]]).expand(4000, 3)
    torch.manual_seed(0)
    traced = trace_light(host, floor, up, with_rays_per_point(1.0))
    across = 0.5 * traced.wi[:, :2] / traced.wi[:, 2:]
    torch.testing.assert_close(traced.hit, (across.abs() < 0.5).all(-1))
    expected = (1.0 + across[traced.hit][:, :1]).expand(-1, 3)
    torch.testing.assert_close(traced.radiance[traced.hit], expected, atol=1e-5, rtol=0.0)

    # L_ref in closed form: a light of 1 everywhere differs from the ceiling by |x|, from the floor by 2 + y.
    model = NeilfModel(
        host, mesh_config(loss=dataclasses.replace(mesh_config().loss, unit="activation")), FACTS
    )
    model.light.radiance = lambda x, wi: torch.ones_like(wi)
    model.config = with_rays_per_point(1.0)
    torch.manual_seed(0)
    term = model._inter_reflection(floor, up)
    torch.testing.assert_close(term.mean(), across[traced.hit][:, 0].abs().mean())
    torch.manual_seed(0)
    term = model._inter_reflection(floor + 0.5 * up, -up)
    assert term.mean().item() == pytest.approx(2.0, abs=0.01)  # y cancels


def test_only_outsides_send_light_and_distances_are_returned():
    """From the middle between floor and ceiling, and from below the floor, whose back is dark and stops
    rays.
    """
    host = mesh_host(two_planes())
    host.radiance_field.forward = lambda x, wo, n, f: torch.where(n[:, 2:] < 0, 1.0, 3.0).expand(-1, 3)
    x = torch.tensor([[0.1, 0.0, 0.25], [0.1, 0.0, -0.25]])
    up = torch.tensor([0.0, 0.0, 1.0])
    met = host.scene_light(x, torch.stack((up, -up, torch.tensor([1.0, 0.0, 0.0]))).expand(2, 3, 3))
    assert met.hit.tolist() == [[True, True, False], [True, False, False]]
    sent = [[1.0, 3.0, 0.0], [0.0, 0.0, 0.0]]
    torch.testing.assert_close(met.radiance, torch.tensor(sent)[..., None].expand(2, 3, 3))
    # Rays start at a small offset from x, but distances are measured from x.
    expected = torch.tensor([[0.25, 0.25, math.inf], [0.25, math.inf, math.inf]])
    torch.testing.assert_close(met.distance, expected)


FACTS = SceneFacts("linear", 0.2, 3.0, "constant")


def test_rays_leave_a_surface_at_every_angle_without_hitting_it():
    torch.manual_seed(0)
    hits = mesh_host(SPHERE).render(rays_at(500, 0.4))
    settings = with_rays_per_point(4.0)
    assert not trace_light(mesh_host(SPHERE), hits.position, hits.normal, settings).hit.any()


# --------------------------------------------------------------------------------------------------- training


def test_r_material_and_light_are_trained_and_the_mesh_is_not():
    host = mesh_host(SPHERE)
    model = NeilfModel(
        host, mesh_config(loss=dataclasses.replace(mesh_config().loss, lambertian=1e-3)), FACTS
    )
    assert set(model.parameter_groups()) == {"radiance", "brdf", "light"}
    terms = model.losses(sphere_batch(), Stage.MATERIAL_INIT)
    weights = active_losses(Stage.MATERIAL_INIT, model.config, model.stages)
    expected = {"volume", "physical", "inter_reflection", "smoothness", "lambertian", "exposure"}
    assert set(weights) == expected
    weigh(terms, weights).loss.backward()
    for name, group in model.parameter_groups().items():
        assert any(p.grad is not None and p.grad.abs().max() > 0 for p in group), name
    assert not any("triangles" in name for name in model.state_dict())


def test_a_mesh_run_from_the_command_line(tmp_path: Path, monkeypatch, capsys):
    monkeypatch.setitem(PRESETS, "tiny", small_config)
    capture, out = make_capture(tmp_path / "sphere", masks=True), tmp_path / "run"
    command = [
        "train",
        "--data",
        str(capture),
        "--preset",
        "tiny",
        "--host",
        "mesh",
        "--out",
        str(out),
        "--device",
        "cpu",
    ]
    assert main(command) == 0
    assert set(json.loads((out / "timing.json").read_text())) == {"material_init"}
    assert (out / "previews" / "material_init.png").is_file()
    assert main(["eval", str(out), "--device", "cpu"]) == 0
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics.pop("health") in ("sound", "doubtful", "failed")
    assert metrics["normal_mae_deg"] < 2.0  # the mesh is a sphere of triangles
    assert {"base_color_psnr", "volume_psnr", "pbr_psnr"} <= set(metrics)
    assert "chamfer" not in metrics
    assert (out / "report.html").is_file()
    assert main(["render", str(out), "--device", "cpu"]) == 0
    assert list((out / "renders").glob("*.exr"))
    assert main(["export", str(out), "--what", "mesh", "--device", "cpu"]) == 0
    mesh = trimesh.load_mesh(out / "export" / "mesh.ply", process=False)
    given = trimesh.load_mesh(capture / "inputs" / "model" / "mesh.ply")
    assert len(mesh.faces) == len(given.faces)
    np.testing.assert_allclose(mesh.bounds, given.bounds, atol=1e-5)
    assert mesh.visual.vertex_colors.shape == (len(mesh.vertices), 4)


def test_weights_belong_to_one_mesh():
    ball, egg = mesh_host(SPHERE), mesh_host(SPHERE.copy().apply_scale([1.0, 1.0, 1.1]))
    weights = ball.state_dict()
    mesh_host(SPHERE).load_state_dict(weights)
    with pytest.raises(UserError, match="not the one that the run was trained on"):
        egg.load_state_dict(weights)
    # Checkpoints of earlier versions have no fingerprint.
    egg.load_state_dict({name: value for name, value in weights.items() if "extra_state" not in name})


def test_a_mesh_is_given_by_its_path_and_loaded_again(tmp_path: Path, monkeypatch, capsys):
    monkeypatch.setitem(PRESETS, "tiny", small_config)
    capture = make_capture(tmp_path / "sphere")
    (capture / "inputs/model/mesh.ply").rename(tmp_path / "scan.ply")
    common = ["train", "--data", str(capture), "--preset", "tiny", "--device", "cpu", "--out"]

    def error(*options: str) -> str:
        assert main([*common, str(tmp_path / "failed"), *options]) == 2
        assert not (tmp_path / "failed").exists()
        return capsys.readouterr().err

    assert "no inputs/model/mesh.ply" in error("--host", "mesh")
    assert "takes no mesh" in error("--mesh", str(tmp_path / "scan.ply"))
    assert "there is no such mesh" in error("--host", "mesh", "--mesh", str(tmp_path / "scanned.ply"))
    (tmp_path / "text.ply").write_text("a table")
    assert "text.ply: not a mesh" in error("--host", "mesh", "--mesh", str(tmp_path / "text.ply"))

    shape = trimesh.load_mesh(tmp_path / "scan.ply", process=False)
    trimesh.Trimesh(shape.vertices, shape.faces[:, ::-1], process=False).export(tmp_path / "inside.ply")
    assert "see the inside" in error("--host", "mesh", "--mesh", str(tmp_path / "inside.ply"))
    trimesh.Trimesh(shape.vertices - CENTER + 90.0, shape.faces, process=False).export(tmp_path / "away.ply")
    assert "no camera sees this mesh" in error("--host", "mesh", "--mesh", str(tmp_path / "away.ply"))
    trimesh.Trimesh(100.0 * shape.vertices, shape.faces, process=False).export(tmp_path / "mm.ply")
    assert "the unit of length of the capture" in error("--host", "mesh", "--mesh", str(tmp_path / "mm.ply"))

    out = tmp_path / "run"
    assert main([*common, str(out), "--host", "mesh", "--mesh", str(tmp_path / "scan.ply")]) == 0
    assert json.loads((out / "config.json").read_text())["config"]["host"]["path"] == str(
        tmp_path / "scan.ply"
    )

    # R was trained on this surface, so neither another one nor another scene frame is accepted.
    given, source = (tmp_path / "scan.ply").read_bytes(), (out / "capture.json").read_text()
    trimesh.Trimesh(shape.vertices * [1, 1, 1.01], shape.faces, process=False).export(tmp_path / "scan.ply")
    for command in (["eval", out], ["export", out], ["render", out], ["relight", out]):
        refused(capsys, [*command, "--device", "cpu"], "not the one that the run was trained on", leaves=out)
    (tmp_path / "scan.ply").write_bytes(given)
    moved = json.loads(source)
    (out / "capture.json").write_text(json.dumps({**moved, "unit": 1.5 * moved["unit"]}))
    refused(capsys, ["eval", out, "--device", "cpu"], "the scene frame has changed", leaves=out)
    (out / "capture.json").write_text(source)

    (tmp_path / "scan.ply").unlink()
    assert main(["eval", str(out), "--device", "cpu"]) == 2
    assert "scan.ply: there is no such mesh" in capsys.readouterr().err
