"""The ground truth of the sphere: depth, normals and materials compared with closed forms; every part is
optional.
"""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from neilfpp_method.data.capture import load_capture
from neilfpp_method.data.files.images import read_image, write_exr, write_png
from neilfpp_method.data.pixels.dataset import PixelDataset
from neilfpp_method.data.truth import Truth
from neilfpp_method.errors import UserError
from tests.data.make_capture import METALLIC, RADIUS, ROUGHNESS, SCALE, base_color, make_capture

SPHERE = RADIUS / SCALE


@pytest.fixture
def truth(tmp_path: Path) -> Truth:
    return Truth(load_capture(make_capture(tmp_path, masks=True)))


def test_depth_normal_and_mask_of_a_view(truth: Truth) -> None:
    views = truth.capture.views
    for i, batch in enumerate(PixelDataset(truth.capture, views).view(i) for i in range(len(views))):
        hit = truth.mask(views[i])
        assert torch.equal(hit, batch.mask == 1)
        axis = torch.from_numpy(views[i].camera.w2c[2, :3]).float()
        position = (
            batch.origins + batch.directions * (truth.depth(views[i]) / (batch.directions @ axis))[:, None]
        )
        assert torch.allclose(position[hit].norm(dim=-1), torch.tensor(SPHERE), atol=1e-5)
        assert torch.allclose(truth.normal(views[i])[hit], position[hit] / SPHERE, atol=1e-5)
        assert (truth.normal(views[i])[~hit] == 0).all()


def test_material_is_linear_and_exists_for_test_views(truth: Truth) -> None:
    (view,) = truth.capture.test_views
    hit, material = truth.mask(view), truth.material(view)
    expected = base_color(truth.normal(view).numpy())
    assert np.allclose(material.base_color[hit], expected[hit], atol=0.51 / 255)
    assert torch.allclose(material.roughness[hit], torch.tensor(ROUGHNESS))
    assert torch.allclose(material.metallic[hit], torch.tensor(METALLIC))
    assert truth.material(truth.capture.train_views[0]) is None


def test_three_equal_channels_are_one(truth: Truth) -> None:
    (view,) = truth.capture.test_views
    before = truth.material(view).roughness
    path = truth.capture.root / "ground_truths" / "materials" / "roughness" / f"{view.name}.png"
    pixels = read_image(path).pixels
    three = np.rint(255 * np.repeat(pixels, 3, axis=-1)).astype(np.uint8)
    write_png(path, three)
    assert torch.equal(truth.material(view).roughness, before)
    three[0, 0] = (0, 128, 255)
    write_png(path, three)
    with pytest.raises(UserError, match="the shape"):
        truth.material(view)


def test_the_true_mesh_is_in_the_scene_frame(truth: Truth) -> None:
    mesh = truth.mesh()
    assert mesh.faces.shape == (1280, 3)  # an icosahedron's 20 faces, each split in 4 three times
    assert torch.allclose(mesh.vertices.norm(dim=-1), torch.tensor(SPHERE), atol=1e-5)


def light_field(points: np.ndarray) -> dict[str, np.ndarray]:
    n, s, k = len(points), 5, 2
    wi, wo = np.zeros((n, s, 3), np.float32), np.ones((n, k, 3), np.float32)
    return {
        **{"points": points, "normals": points, "base_color": points, "roughness": np.full(n, 0.3)},
        **{"metallic": np.zeros(n), "wi": wi, "incident": wi.astype(np.float16), "wo": wo, "outgoing": wo},
    }


def test_a_light_field_is_read_in_the_scene_frame_and_checked(truth: Truth) -> None:
    (truth.capture.root / "light").mkdir()
    path = truth.capture.root / "light" / "light_field_gt.npz"
    points = np.random.default_rng(0).normal(size=(4, 3)).astype(np.float32)
    np.savez(path, **light_field(points))
    field = truth.light_field()
    assert torch.allclose(
        truth.capture.normalization.to_world(field.position), torch.from_numpy(points), atol=1e-6
    )
    assert field.incident.shape == (4, 5, 3)
    assert field.material.roughness.shape == (4, 1)
    np.savez(path, **(light_field(points) | {"incident": np.zeros((4, 6, 3))}))
    with pytest.raises(
        UserError, match=r"light_field_gt\.npz: not a light field \(incident has the shape \(4, 6, 3\)"
    ):
        truth.light_field()
    np.savez(path, **(light_field(points) | {"wo": np.array([{"code": "runs"}])}))
    with pytest.raises(UserError, match="values of the type object"):
        truth.light_field()


def test_everything_is_optional(truth: Truth) -> None:
    for folder in ("inputs/depth_maps", "inputs/normal_maps", "inputs/model", "ground_truths"):
        shutil.rmtree(truth.capture.root / folder)
    view = truth.capture.test_views[0]
    found = (
        truth.depth(view),
        truth.normal(view),
        truth.mask(view),
        truth.material(view),
        truth.mesh(),
        truth.light_field(),
    )
    assert found == (None,) * 6


def test_damaged_truth_is_named(truth: Truth) -> None:
    inputs, view = truth.capture.inputs, truth.capture.views[2]
    write_exr(inputs / "depth_maps" / "002.exr", {"Y": np.zeros((18, 20), np.float32)})
    write_exr(inputs / "normal_maps" / "002.exr", {"RGB": np.full((18, 24, 3), np.nan, np.float32)})
    (inputs / "model" / "mesh.ply").write_bytes((inputs / "model" / "mesh.ply").read_bytes()[:900])
    with pytest.raises(UserError, match=r"depth_maps/002\.exr: the shape \(18, 20, 1\)"):
        truth.depth(view)
    with pytest.raises(UserError, match=r"normal_maps/002\.exr: a pixel is not finite"):
        truth.normal(view)
    with pytest.raises(UserError, match=r"mesh\.ply"):
        truth.mesh()
