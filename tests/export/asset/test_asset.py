"""An asset, read by the readers of other programs and compared with the field and the sphere that it was made
from.
"""

from __future__ import annotations

import errno
import io
import json
import math
import struct
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from scipy.ndimage import map_coordinates

from neilfpp_method.data.files.images import read_image
from neilfpp_method.errors import UserError
from neilfpp_method.export.asset import files as files_module
from neilfpp_method.export.asset import texels
from neilfpp_method.export.asset.atlas import Unwrapped
from neilfpp_method.export.asset.bake import Detail, Textures, bake
from neilfpp_method.export.asset.glb import WORLD_TO_GLTF, glb_bytes
from neilfpp_method.export.asset.surface import creased
from neilfpp_method.export.asset.usd import has_usd, usd_text
from tests.data.make_capture import CENTER, SCALE, srgb
from tests.export.asset.balls import (
    AXIS,
    BULB,
    INTENSITY,
    PANEL,
    RADIUS,
    RIPPLES,
    Ball,
    ball_run,
    material,
    write_ball,
)

SIZE = 256


@pytest.fixture(scope="module")
def asset(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("ball")
    write_ball(
        ball_run(folder), folder / "asset", SIZE, deviations=lambda run, points: 0.5 + 0.5 * points.position
    )
    return folder / "asset"


@pytest.fixture(scope="module")
def shape(asset: Path) -> trimesh.Trimesh:
    return trimesh.load(asset / "asset.glb", process=False).geometry["surface"]


def to_scene(gltf: np.ndarray) -> np.ndarray:
    """(x, y, z) of glTF is (x, −z, y) of the world; one scene unit is SCALE of the world about CENTER."""
    x, y, z = gltf.T
    return (np.stack([x, -z, y], axis=1) - CENTER) / SCALE


def random_points(shape: trimesh.Trimesh, count: int = 4000):
    """Points distributed uniformly over the triangles, and a function that interpolates vertex values
    there.
    """
    points, face = trimesh.sample.sample_surface(shape, count, seed=1)
    weights = trimesh.triangles.points_to_barycentric(shape.triangles[face], points)
    return np.asarray(points), lambda values: (values[shape.faces[face]] * weights[..., None]).sum(1)


def look_up(picture: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Bilinear, v upwards, as a renderer does it; values of 0 … 255."""
    height, width = picture.shape[:2]
    at = [(1 - uv[:, 1]) * height - 0.5, uv[:, 0] * width - 0.5]
    return np.stack(
        [map_coordinates(channel, at, order=1, mode="nearest") for channel in np.moveaxis(picture, -1, 0)],
        axis=1,
    )


def gltf_tree(path: Path) -> dict:
    contents = path.read_bytes()
    length = struct.unpack("<I", contents[12:16])[0]
    return json.loads(contents[20 : 20 + length])


def test_textures_agree_with_the_field(shape):
    points, at_vertices = random_points(shape)
    uv = at_vertices(shape.visual.uv)
    truth = material(torch.from_numpy(to_scene(points)))
    pbr = shape.visual.material
    # The coarse surface is up to 0.003 scene units off, and the field changes by 1 a unit: 255 · 0.003 is
    # less than 1.
    base_color = look_up(np.array(pbr.baseColorTexture, float), uv)
    np.testing.assert_allclose(base_color, 255 * srgb(truth.base_color.numpy()), atol=2)
    packed = look_up(np.array(pbr.metallicRoughnessTexture, float), uv)
    np.testing.assert_allclose(packed[:, 1], 255 * truth.roughness.numpy()[:, 0], atol=2)
    np.testing.assert_allclose(packed[:, 2], 255 * truth.metallic.numpy()[:, 0], atol=2)
    np.testing.assert_allclose(packed[:, 0], 255)
    assert pbr.metallicFactor == pbr.roughnessFactor == 1.0
    np.testing.assert_array_equal(pbr.baseColorFactor, 255)


def test_the_other_files_have_the_same_contents(asset, shape):
    pbr = shape.visual.material
    for name, texture in (("base_color", pbr.baseColorTexture), ("normal", pbr.normalTexture)):
        stored = read_image(asset / "textures" / f"{name}.png").pixels
        np.testing.assert_array_equal(np.rint(255 * stored), np.array(texture))
    packed = read_image(asset / "textures" / "metallic_roughness.png").pixels
    for name, channel in (("roughness", 1), ("metallic", 2)):
        np.testing.assert_array_equal(
            read_image(asset / "textures" / f"{name}.png").pixels[..., 0], packed[..., channel]
        )
    points, at_vertices = random_points(shape)
    deviation = look_up(
        255 * read_image(asset / "textures" / "deviation.png").pixels.astype(float),
        at_vertices(shape.visual.uv),
    )
    np.testing.assert_allclose(deviation, 255 * (0.5 + 0.5 * to_scene(points)), atol=2)


def test_the_surface_is_upright_and_faces_outwards(shape):
    scene = to_scene(np.array(shape.vertices))
    np.testing.assert_allclose(np.linalg.norm(scene, axis=1), RADIUS, atol=0.02)
    # The first camera is above the sphere, on the side of +X: the sphere is complete there, but not below.
    from_center = np.array(shape.vertices) - np.array([CENTER[0], CENTER[2], -CENTER[1]])
    cosine = (np.array(shape.vertex_normals) * from_center).sum(1) / np.linalg.norm(from_center, axis=1)
    assert cosine.min() > 0.95
    assert ((shape.face_normals * (shape.triangles_center - shape.vertices.mean(0))).sum(1) > 0).all()


def test_charts_lie_inside_the_texture_and_do_not_overlap(shape):
    uv = np.array(shape.visual.uv)
    assert uv.min() >= 0
    assert uv.max() <= 1
    corners = uv[shape.faces]
    points = np.random.default_rng(0).uniform(0, 1, (1500, 2))
    first, second, to_point = (
        corners[:, 1] - corners[:, 0],
        corners[:, 2] - corners[:, 0],
        points[:, None] - corners[:, 0],
    )

    def cross(one: np.ndarray, other: np.ndarray) -> np.ndarray:
        return one[..., 0] * other[..., 1] - one[..., 1] * other[..., 0]

    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (cross(*pair) / cross(first, second) for pair in ((to_point, second), (first, to_point)))
        inside = ((a > 1e-6) & (b > 1e-6) & (a + b < 1 - 1e-6)).sum(axis=1)
    assert inside.max() == 1
    assert 0.3 < (inside == 1).mean() < 0.9


def test_the_normal_map_gives_the_normals_of_the_fine_surface(tmp_path):
    """By the frame of the file's own tangents. Ripples of 0.015 · 12 = 0.18, 10°, are finer than the coarse
    triangles."""
    asset = tmp_path / "asset"
    write_ball(ball_run(tmp_path, host=Ball(0.015)), asset, SIZE, faces=300, resolution=192)
    tree = gltf_tree(asset / "asset.glb")
    contents = (asset / "asset.glb").read_bytes()
    start = 20 + struct.unpack("<I", contents[12:16])[0] + 8

    def accessor(number: int, columns: int) -> np.ndarray:
        view = tree["bufferViews"][tree["accessors"][number]["bufferView"]]
        data = contents[start + view["byteOffset"] : start + view["byteOffset"] + view["byteLength"]]
        return np.frombuffer(data, "<f4").reshape(-1, columns).astype(float)

    attributes = tree["meshes"][0]["primitives"][0]["attributes"]
    normal, tangent = accessor(attributes["NORMAL"], 3), accessor(attributes["TANGENT"], 4)
    np.testing.assert_allclose(np.linalg.norm(tangent[:, :3], axis=1), 1, atol=1e-5)
    np.testing.assert_allclose((tangent[:, :3] * normal).sum(1), 0, atol=1e-5)
    assert set(np.unique(tangent[:, 3])) <= {-1.0, 1.0}
    shape = trimesh.load(asset / "asset.glb", process=False).geometry["surface"]
    points, at_vertices = random_points(shape)
    n, t, sign = at_vertices(normal), at_vertices(tangent[:, :3]), np.sign(at_vertices(tangent[:, 3:]))
    x, y, z = (
        look_up(np.array(shape.visual.material.normalTexture, float), at_vertices(shape.visual.uv)) / 127.5
        - 1
    ).T[..., None]
    bumped = x * t + y * sign * np.cross(n, t) + z * n
    bumped /= np.linalg.norm(bumped, axis=1, keepdims=True)
    scene = to_scene(points)
    truth = scene / np.linalg.norm(scene, axis=1, keepdims=True)
    truth[:, 2] -= 0.015 * RIPPLES * np.cos(RIPPLES * scene[:, 2])
    truth = (truth / np.linalg.norm(truth, axis=1, keepdims=True))[:, [0, 2, 1]] * [1, 1, -1]

    def off(directions: np.ndarray) -> float:
        cosine = (directions * truth).sum(1) / np.linalg.norm(directions, axis=1)
        return float(np.degrees(np.arccos(cosine.clip(-1, 1))).mean())

    assert off(bumped) < 0.6
    assert off(bumped) < 0.25 * off(n)


def test_the_progress_of_baking_never_goes_back(tmp_path, monkeypatch):
    monkeypatch.setattr(texels, "TEXELS_AT_ONCE", 64)
    corners, faces = np.array([[-0.2, 0.0, 0.8], [0.2, 0.0, 0.8], [0.0, 0.2, 0.8]]), np.array([[0, 1, 2]])
    uv = np.array([[0.0, 0.8], [1.0, 0.8], [1.0, 1.0]])  # only the first of four batches has texels
    mesh = Unwrapped(corners, np.tile([0.0, 0.0, 1.0], (3, 1)), uv, faces, charts=1, gap=2.0)
    done: list[float] = []
    bake(ball_run(tmp_path), mesh, Detail(creased(corners, faces), 0.01), 16, on_progress=done.append)
    assert done == [0.25, 0.5, 0.75, 1.0]


def test_lamps_keep_their_positions(asset):
    tree = gltf_tree(asset / "asset.glb")
    assert tree["extensionsUsed"] == ["KHR_lights_punctual"]
    lights = tree["extensions"]["KHR_lights_punctual"]["lights"]
    nodes = [node for node in tree["nodes"] if "extensions" in node]
    assert {tree["nodes"].index(node) for node in nodes} <= set(tree["scenes"][0]["nodes"])
    assert [light["type"] for light in lights] == ["point", "spot"]
    for node, place, intensity in zip(nodes, (BULB, PANEL), INTENSITY, strict=True):
        light = lights[node["extensions"]["KHR_lights_punctual"]["light"]]
        np.testing.assert_allclose(to_scene(np.array([node["translation"]]))[0], place, atol=1e-6)
        np.testing.assert_allclose(
            np.array(light["color"]) * light["intensity"], np.array(intensity) * SCALE**2, rtol=1e-6
        )
    # A spot looks along −Z of its node.
    looks = trimesh.transformations.quaternion_matrix(np.roll(nodes[1]["rotation"], 1))[:3, :3] @ [0, 0, -1]
    np.testing.assert_allclose(looks, [AXIS[0], AXIS[2], -AXIS[1]], atol=1e-6)
    assert lights[1]["spot"] == {"innerConeAngle": 0.0, "outerConeAngle": pytest.approx(math.pi / 2)}


def test_usd_can_be_read(asset, shape):
    usd = pytest.importorskip("pxr.Usd")
    from pxr import UsdGeom, UsdLux, UsdShade

    stage = usd.Stage.Open(str(asset / "asset.usda"))
    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/asset/surface"))
    points = np.array(mesh.GetPointsAttr().Get())
    np.testing.assert_allclose(points, np.array(shape.vertices)[:, [0, 2, 1]] * [1, -1, 1], atol=1e-5)
    np.testing.assert_array_equal(np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3), shape.faces)
    place = np.array(UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st").Get())
    np.testing.assert_allclose(place, shape.visual.uv, atol=1e-6)
    bound = UsdShade.MaterialBindingAPI(mesh.GetPrim()).ComputeBoundMaterial()[0]
    surface = bound.ComputeSurfaceSource()[0]
    assert surface.GetIdAttr().Get() == "UsdPreviewSurface"
    for name, file, channel in (
        ("diffuseColor", "base_color", "rgb"),
        ("roughness", "metallic_roughness", "g"),
        ("metallic", "metallic_roughness", "b"),
        ("normal", "normal", "rgb"),
    ):
        source, output, _ = surface.GetInput(name).GetConnectedSource()
        texture = UsdShade.Shader(source)
        assert output == channel
        assert Path(texture.GetInput("file").Get().resolvedPath) == asset / "textures" / f"{file}.png"
    lamp = UsdLux.DiskLight(stage.GetPrimAtPath("/asset/lamp_1"))
    looks = UsdGeom.Xformable(lamp).ComputeLocalToWorldTransform(0).TransformDir((0, 0, -1))
    np.testing.assert_allclose(looks, AXIS, atol=1e-5)
    area = math.pi * lamp.GetRadiusAttr().Get() ** 2
    power = np.array(lamp.GetColorAttr().Get()) * lamp.GetIntensityAttr().Get() * area
    np.testing.assert_allclose(power, np.array(INTENSITY[1]) * SCALE**2, rtol=1e-4)


# ------------------------------------------------------------------------------------------------ bad weather


def test_an_asset_far_from_the_origin_keeps_its_shape():
    """In map coordinates single precision has steps of half a metre."""
    ball, place = trimesh.creation.icosphere(subdivisions=2, radius=0.15), np.array([5e5, 4e6, 100.0])
    uv = np.random.default_rng(0).uniform(size=(len(ball.vertices), 2))
    normals = np.array(ball.vertex_normals)
    mesh = Unwrapped(np.array(ball.vertices) + place, normals, uv, np.array(ball.faces), 1, 2.0)
    pixels = np.zeros((4, 4, 3), np.uint8)
    textures = Textures(pixels, pixels[..., :1], pixels[..., :1], pixels, 1.0, None)
    scene = trimesh.load(io.BytesIO(glb_bytes(mesh, textures, [])), file_type="glb", process=False)
    (node,) = scene.graph.nodes_geometry
    transform, name = scene.graph[node]
    shape = scene.geometry[name]
    assert np.allclose(transform[:3, 3], WORLD_TO_GLTF @ place, atol=1e-3)
    assert np.allclose(shape.vertices @ WORLD_TO_GLTF, ball.vertices, atol=1e-6)
    if has_usd():
        from pxr import Usd, UsdGeom

        stage = Usd.Stage.CreateInMemory()
        stage.GetRootLayer().ImportFromString(usd_text(mesh, []))
        surface = UsdGeom.Mesh(stage.GetPrimAtPath("/asset/surface"))
        assert np.allclose(surface.GetPointsAttr().Get(), ball.vertices, atol=1e-6)
        moved = surface.ComputeLocalToWorldTransform(0).ExtractTranslation()
        assert np.allclose(moved, place, atol=1e-3)


def test_a_full_disk_leaves_nothing(tmp_path, monkeypatch):
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    run = ball_run(tmp_path)
    monkeypatch.setattr(files_module, "glb_bytes", full)
    with pytest.raises(UserError, match="No space left on device"):
        write_ball(run, tmp_path / "out" / "asset", 64)
    assert not [path for path in (tmp_path / "out").rglob("*") if path.is_file()]
    assert not (tmp_path / "out" / "asset").exists()


def test_other_files_in_the_folder_are_kept(tmp_path):
    run = ball_run(tmp_path, kind="free")
    (tmp_path / "asset").mkdir()
    (tmp_path / "asset" / "mine.blend").write_text("work of a week")
    write_ball(run, tmp_path / "asset", 64)
    assert (tmp_path / "asset" / "mine.blend").read_text() == "work of a week"
    assert (tmp_path / "asset" / "asset.glb").is_file()
    # A light that is free at every point has no map and no lamps.
    described = json.loads((tmp_path / "asset" / "scene.json").read_text())
    assert described["environment"] is None
    assert described["lamps"] == []
    assert not list((tmp_path / "asset").glob("*.exr"))
    assert "extensions" not in gltf_tree(tmp_path / "asset" / "asset.glb")


def test_an_atlas_that_does_not_fit_is_refused(tmp_path, monkeypatch):
    with pytest.raises(UserError, match=r"charts .* do not fit on a texture of 8×8; raise --texture-size"):
        write_ball(ball_run(tmp_path), tmp_path / "asset", 8)
    assert not (tmp_path / "asset").exists()


def test_without_usd_the_other_files_are_written(tmp_path, monkeypatch):
    monkeypatch.setattr("neilfpp_method.export.asset.usd.Usd", None)
    write_ball(ball_run(tmp_path), tmp_path / "asset", 64)
    assert (tmp_path / "asset" / "asset.glb").is_file()
    assert not (tmp_path / "asset" / "asset.usda").exists()
