"""Captures: cameras compared with the projection matrix, the scene frame, the published layout, and the
split.
"""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
import torch

from neilfpp_method.data.cameras.projection import camera_rays, project
from neilfpp_method.data.capture import load_capture
from tests.data.make_capture import CENTER, RADIUS, SCALE, camera_pose, make_capture

DATA = Path(os.environ.get("NEILFPP_DATA", Path(__file__).parents[2].parent / "shared" / "data"))


def edit_scene(root: Path, change) -> None:
    path = root / "inputs" / "sfm_scene.json"
    scene = json.loads(path.read_text())
    change(scene)
    path.write_text(json.dumps(scene))


# ---------------------------------------------------------------------------------------------------- cameras


def test_projection_is_k_times_w2c(tmp_path: Path) -> None:
    camera = load_capture(make_capture(tmp_path)).views[1].camera
    points = torch.randn(50, 3, dtype=torch.float64)
    k = np.array([[1.4 * 18, 0, 12.5], [0, 1.5 * 18, 8.75], [0, 0, 1]])
    homogeneous = np.concatenate([points.numpy(), np.ones((50, 1))], axis=1)
    image = homogeneous @ camera_pose(1, 6)[:3].T @ k.T
    seen = project(camera, points)
    assert np.allclose(seen.pixel.numpy(), image[:, :2] / image[:, 2:], atol=1e-9)
    assert np.allclose(seen.depth.numpy(), image[:, 2])


@pytest.mark.parametrize("frame", ["world", "scene"])
def test_rays_project_back_to_pixel_centers(tmp_path: Path, frame: str) -> None:
    capture = load_capture(make_capture(tmp_path))
    for view in capture.views:
        camera = view.camera if frame == "world" else capture.scene_camera(view)
        rays = camera_rays(camera, torch.float64)
        assert torch.allclose(rays.directions.norm(dim=-1), torch.ones((), dtype=torch.float64))
        seen = project(camera, rays.origins + rays.directions * torch.linspace(0.5, 9, len(rays))[:, None])
        rows, columns = np.mgrid[:18, :24]
        expected = np.stack([columns.ravel() + 0.5, rows.ravel() + 0.5], axis=1)
        assert np.allclose(seen.pixel.numpy(), expected, atol=1e-9)
        assert (seen.depth > 0).all()


def test_the_scene_frame_keeps_projections(tmp_path: Path) -> None:
    capture = load_capture(make_capture(tmp_path))
    to_scene, to_world = capture.normalization.to_scene, capture.normalization.to_world
    north = torch.tensor([[CENTER[0], CENTER[1], CENTER[2] + RADIUS]], dtype=torch.float64)
    assert torch.allclose(to_scene(north), torch.tensor([[0, 0, RADIUS / SCALE]], dtype=torch.float64))
    points = torch.randn(2, 7, 3, dtype=torch.float64)
    assert torch.allclose(to_world(to_scene(points)), points)
    camera = capture.views[3].camera
    world, scene = (
        project(camera, points[0]),
        project(capture.normalization.camera(camera), to_scene(points[0])),
    )
    assert torch.allclose(world.pixel, scene.pixel)
    assert torch.allclose(world.depth / SCALE, scene.depth)


# ------------------------------------------------------------------------------------------- published layout


def test_views_are_read_in_order_and_invalid_ones_left_out(tmp_path: Path) -> None:
    make_capture(tmp_path, views=12)
    edit_scene(tmp_path, lambda scene: scene["camera_track_map"]["images"]["1"].update(flg=0))
    capture = load_capture(tmp_path)
    assert [view.index for view in capture.views] == [0, *range(2, 12)]
    assert capture.views[1].name == "002"
    assert np.allclose(capture.views[1].camera.w2c, camera_pose(2, 12))
    assert capture.point_cloud == tmp_path / "inputs" / "model" / "oriented_pcd.ply"
    assert capture.hdr
    assert all(view.mask is None for view in capture.views)


@pytest.mark.parametrize("place", ["sfm_scene.json", "inputs/model/sfm_scene.json"])
def test_the_scene_file_may_lie_elsewhere(tmp_path: Path, place: str) -> None:
    make_capture(tmp_path)
    (tmp_path / "inputs" / "sfm_scene.json").rename(tmp_path / place)
    capture = load_capture(tmp_path)
    assert capture.inputs == tmp_path / "inputs"
    assert capture.views[0].image == tmp_path / "inputs" / "images" / "000.exr"


def test_nested_matrices_single_focals_and_other_suffixes_are_taken(tmp_path: Path) -> None:
    make_capture(tmp_path, masks=True)

    def change(scene: dict) -> None:
        for i, track in scene["camera_track_map"]["images"].items():
            track["camera"]["extrinsic"] = np.reshape(track["camera"]["extrinsic"], (4, 4)).tolist()
            track["camera"]["intrinsic"]["focal"] = 30.0 if i == "0" else [30.0]
            scene["image_path"]["file_paths"][i] = f"images/{int(i):03d}.png"  # the files are .exr

    edit_scene(tmp_path, change)
    capture = load_capture(tmp_path)
    assert capture.views[0].camera.fx == capture.views[1].camera.fy == 30.0
    assert capture.views[0].image.suffix == ".exr"
    assert capture.views[0].mask == tmp_path / "inputs" / "masks" / "000.png"


def test_without_a_box_the_point_cloud_defines_the_scene(tmp_path: Path) -> None:
    make_capture(tmp_path)
    edit_scene(tmp_path, lambda scene: scene.pop("bbox"))
    normalization = load_capture(tmp_path).normalization
    assert normalization.scale == pytest.approx(RADIUS, rel=0.01)
    assert normalization.center == pytest.approx(CENTER, abs=0.02)


# ----------------------------------------------------------------------------------------- split and response


def test_views_are_held_out_by_options_then_files_then_the_default(tmp_path: Path) -> None:
    make_capture(tmp_path, views=17, test=(4, 9))

    def held_out(**options) -> list[str]:
        return [view.name for view in load_capture(tmp_path, **options).test_views]

    assert held_out() == ["004", "009"]
    assert held_out(test_every=5) == ["004", "009", "014"]
    assert held_out(test_every=0) == []
    assert held_out(test_every=5, test=[3, "016"]) == ["003", "016"]
    (tmp_path / "split.json").write_text('\ufeff{"test": ["002", 11]}', "utf-8")
    assert held_out() == ["002", "011"]
    (tmp_path / "split.json").unlink()
    assert held_out() == ["007", "015"]
    assert len(load_capture(tmp_path).train_views) == 15


def test_split_numbers_are_the_numbers_of_the_scene_file(tmp_path: Path) -> None:
    make_capture(tmp_path, test=(4,))
    edit_scene(tmp_path, lambda scene: scene["camera_track_map"]["images"]["1"].update(flg=1))
    assert load_capture(tmp_path).test == {"004"}


@pytest.mark.parametrize("hdr", [True, False])
def test_response_comes_from_the_files_or_the_user(tmp_path: Path, hdr: bool) -> None:
    make_capture(tmp_path, hdr=hdr)
    assert load_capture(tmp_path).hdr == hdr
    assert load_capture(tmp_path, response="linear").hdr
    assert not load_capture(tmp_path, response="srgb").hdr


def test_the_summary_names_views_pixels_and_scene(tmp_path: Path) -> None:
    summary = load_capture(make_capture(tmp_path / "ball", masks=True)).summary.splitlines()
    assert summary[0] == "ball (sfm_scene): 6 views of 24×18, 5 to train on and 1 to test on"
    assert summary[1] == "pixels: linear HDR; mask files: 6; point cloud: oriented_pcd.ply"
    assert (
        summary[2]
        == "scene: centre (0.3, -0.2, 0.5), 1 scene unit = 1.5 world units, as stated by the capture"
    )


# -------------------------------------------------------------------------------------------------- real data


@pytest.mark.skipif(
    not DATA.is_dir(), reason="the shared captures are not here; NEILFPP_DATA says where they are"
)
@pytest.mark.parametrize("name", ["tabletop_env", "tabletop_mix"])
def test_shared_captures(name: str) -> None:
    capture = load_capture(DATA / name)
    assert len(capture.train_views) == 32
    assert [view.index for view in capture.test_views] == [4, 9, 14, 19, 24, 29, 34, 39]
    assert capture.normalization.scale == pytest.approx(1.89 / 2)
    assert capture.hdr
    assert capture.views[0].camera.fx == pytest.approx(260.50890647)
