"""`ns-export` on a run of `ns-train neilfpp`: its clouds and meshes lie on the surface of the model.

Only nerfstudio's marching cubes, which need a GPU, are replaced.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import open3d
import pytest
import torch
import trimesh
from nerfstudio.fields.sdf_field import SDFField
from nerfstudio.scripts import exporter
from nerfstudio.utils.eval_utils import eval_setup
from PIL import Image
from skimage.measure import marching_cubes
from torch.nn.functional import normalize

from neilfpp_method.plugin.exporting import stored_colors
from neilfpp_method.plugin.model import NeilfMethod, NeilfMethodConfig
from neilfpp_method.settings.presets import fixed_geometry
from neilfpp_method.shading.color import tone_map
from tests.data.make_capture import make_capture
from tests_nerfstudio.runs import ns_train, small_settings, trainer_config

TEXTURE = {"num_pixels_per_side": 64, "target_num_faces": 2000}


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """The configuration of a run whose surface is still close to the ball with which it began."""
    data = make_capture(tmp_path_factory.mktemp("capture"), size=(48, 36), test=(0, 1), background=0.3)
    return ns_train(trainer_config(data, tmp_path_factory.mktemp("run"), small_settings())) / "config.yml"


@pytest.fixture(scope="module")
def model(run: Path) -> NeilfMethod:
    return eval_setup(run)[1].model


def errors(model: NeilfMethod, points: np.ndarray) -> np.ndarray:
    """Distances of points from the surface of the model, scene units, in increasing order."""
    with torch.no_grad():
        return model.neilf.host.sdf(torch.from_numpy(np.array(points)).float()).abs().sort().values.numpy()


def textured(folder: Path) -> np.ndarray:
    """The texels on the mesh of a folder, which the OBJ file there refers to."""
    assert trimesh.load(folder / "mesh.obj").visual.uv.shape[1] == 2
    pixels = np.asarray(Image.open(folder / "material_0.png"))
    return pixels[pixels.any(-1)]


@pytest.mark.parametrize("name", ["rgb", "base_color"])
def test_a_cloud_lies_on_the_surface(run: Path, model: NeilfMethod, tmp_path: Path, name: str) -> None:
    exporter.ExportPointCloud(
        run, tmp_path, num_points=600, num_rays_per_batch=512, rgb_output_name=name
    ).main()
    cloud = open3d.io.read_point_cloud(str(tmp_path / "point_cloud.ply"))
    points, normals, colors = (
        torch.from_numpy(np.array(part)).float() for part in (cloud.points, cloud.normals, cloud.colors)
    )
    off = errors(model, points.numpy())
    assert off[int(0.9 * len(off))] < 0.0035
    outward = normalize(model.neilf.host.sdf_field.with_gradient(points).gradient, dim=-1).detach()
    assert (outward * normals).sum(-1).quantile(0.1) > 0.975
    if name == "base_color":
        # Eight bits per channel, rounded down.
        expected = tone_map(model.neilf.brdf(points).base_color).detach()
        torch.testing.assert_close(colors, expected, atol=1.5 / 255, rtol=0)


def test_a_poisson_mesh_lies_on_the_surface(run: Path, model: NeilfMethod, tmp_path: Path) -> None:
    exporter.ExportPoissonMesh(
        run, tmp_path, num_points=600, num_rays_per_batch=512, texture_method="point_cloud"
    ).main()
    off = errors(model, trimesh.load(tmp_path / "poisson_mesh.ply").vertices)
    assert off[len(off) // 2] < 0.007


def test_a_fused_mesh_lies_on_the_surface_and_has_a_texture(
    run: Path, model: NeilfMethod, tmp_path: Path
) -> None:
    exporter.ExportTSDFMesh(run, tmp_path, downscale_factor=1, resolution=[48] * 3, **TEXTURE).main()
    off = errors(model, trimesh.load(tmp_path / "tsdf_mesh.ply").vertices)
    assert off[len(off) // 2] < 0.02
    assert 60 < textured(tmp_path).mean() < 200


def test_marching_cubes_uses_the_distance_field(
    run: Path, model: NeilfMethod, tmp_path: Path, monkeypatch
) -> None:
    def on_a_coarse_grid(geometry_callable_field, **_: object) -> trimesh.Trimesh:
        axis = torch.linspace(-1.0, 1.0, 33)
        points = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1).view(-1, 3)
        values = geometry_callable_field(points).detach().view(33, 33, 33).numpy()
        vertices, faces, _, _ = marching_cubes(values, 0.0, spacing=(2 / 32,) * 3)
        return trimesh.Trimesh(vertices - 1.0, faces)

    monkeypatch.setattr(exporter, "generate_mesh_with_multires_marching_cubes", on_a_coarse_grid)
    exporter.ExportMarchingCubesMesh(run, tmp_path, **TEXTURE).main()
    off = errors(model, trimesh.load(tmp_path / "sdf_marching_cubes_mesh.ply").vertices)
    assert off[len(off) // 2] < 0.0007
    assert 60 < textured(tmp_path).mean() < 200


def test_only_hosts_with_a_distance_field_offer_one(tmp_path: Path) -> None:
    def offers(**options: object) -> bool:
        return hasattr(NeilfMethodConfig(**options), "sdf_field")

    assert offers()
    assert offers(host="neus")
    assert not offers(host="nerfacto")
    assert not offers(neilf=fixed_geometry(small_settings()))
    config = trainer_config(make_capture(tmp_path), tmp_path, small_settings(), host="neus")
    config.pipeline.datamanager.data = tmp_path
    assert isinstance(config.pipeline.setup(device="cpu").model.field, SDFField)


def test_cameras_are_those_of_the_capture(run: Path, tmp_path: Path) -> None:
    exporter.ExportCameraPoses(run, tmp_path).main()
    cameras = eval_setup(run)[1].datamanager.train_dataset.cameras.camera_to_worlds
    frames = json.loads((tmp_path / "transforms_train.json").read_text())
    torch.testing.assert_close(torch.tensor([frame["transform"] for frame in frames]), cameras)


def test_stored_colors_are_display_values() -> None:
    # Linear 0.5 is 1.055 · 0.5^(1/2.4) − 0.055 = 0.7354 in sRGB.
    outputs = {
        "rgb": torch.tensor([[0.5, 4.0, 0.0]]),
        "base_color": torch.tensor([[0.5, 1.0, 0.0]]),
        "roughness": torch.tensor([[0.5]]),
        "accumulation": torch.tensor([[0.25]]),
    }

    def stored(name: str, response: str = "linear") -> list[float]:
        return stored_colors(outputs, name, response)[0].tolist()

    assert stored("rgb") == pytest.approx([0.7354, 1.0, 0.0, 0.25], abs=1e-4)
    assert stored("rgb", "srgb") == pytest.approx([0.5, 1.0, 0.0, 0.25])
    assert stored("base_color", "srgb") == pytest.approx([0.7354, 1.0, 0.0, 0.25], abs=1e-4)
    assert stored("roughness") == pytest.approx([0.5, 0.5, 0.5, 0.25])
