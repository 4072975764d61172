"""Known points project to known pixels: in every layout, with z, y or another direction up, and with every
lens in the package's own layout.
"""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch
from scipy.spatial.transform import Rotation

from neilfpp_method.data.cameras.lens import LENSES
from neilfpp_method.data.cameras.projection import project
from neilfpp_method.data.capture import READERS, load_capture
from tests.data.cameras.test_lens import COEFFICIENTS
from tests.data.formats.scenes import (
    FOCAL,
    HEIGHT,
    POINTS,
    POSES,
    PRINCIPAL,
    VIEWS,
    WIDTH,
    local,
    material,
    pinhole_pixels,
)
from tests.data.make_capture import CENTER, SCALE

TOLERANCE = 0.01
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
K = np.array([[FOCAL[0], 0, PRINCIPAL[0]], [0, FOCAL[1], PRINCIPAL[1]], [0, 0, 1]])
NAMES = [f"{i:03d}.exr" for i in range(VIEWS)]


def moved(rotation: Rotation, shift: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> np.ndarray:
    """Transformation from the world of `scenes`, in which z is up, to another world."""
    world = np.eye(4)
    world[:3, :3], world[:3, 3] = rotation.as_matrix(), shift
    return world


WORLDS = {
    "z up": moved(Rotation.identity()),
    "y up": moved(Rotation.from_euler("x", -90, degrees=True)),
    "y down": moved(Rotation.from_euler("x", 90, degrees=True)),
    "anywhere": moved(Rotation.from_euler("xyz", (20, -70, 130), degrees=True), (12.0, -3.0, 7.0)),
}


def neilfpp(root: Path, w2c: list[np.ndarray], center: np.ndarray, lens: dict | None = None) -> None:
    camera = {
        "fx": FOCAL[0],
        "fy": FOCAL[1],
        "cx": PRINCIPAL[0],
        "cy": PRINCIPAL[1],
        "width": WIDTH,
        "height": HEIGHT,
    }
    camera |= {"lens": lens} if lens else {}
    views = [
        {"name": str(i), "image": f"images/{name}", "camera": camera | {"w2c": pose.tolist()}}
        for i, (name, pose) in enumerate(zip(NAMES, w2c, strict=True))
    ]
    scene = {"centre": center.tolist(), "radius": SCALE}
    content = {
        "format": "neilfpp-capture",
        "version": 1,
        "response": "linear",
        "scene": scene,
        "views": views,
    }
    (root / "capture.json").write_text(json.dumps(content))


def sfm_scene(root: Path, w2c: list[np.ndarray], center: np.ndarray) -> None:
    (root / "inputs").mkdir()
    (root / "images").rename(root / "inputs" / "images")
    camera = {"intrinsic": {"focal": list(FOCAL), "ppt": list(PRINCIPAL)}}
    tracks = {
        str(i): {"flg": 2, "size": [WIDTH, HEIGHT], "camera": camera | {"extrinsic": pose.ravel().tolist()}}
        for i, pose in enumerate(w2c)
    }
    box = np.diag([2 * SCALE] * 3 + [1.0])
    box[:3, 3] = center
    scene = {
        "camera_track_map": {"images": tracks},
        "image_path": {"file_paths": {str(i): f"images/{name}" for i, name in enumerate(NAMES)}},
        "bbox": {"transform": box.ravel().tolist()},
    }
    (root / "inputs" / "sfm_scene.json").write_text(json.dumps(scene))


def dtu(root: Path, w2c: list[np.ndarray], center: np.ndarray) -> None:
    (root / "images").rename(root / "image")
    to_whole_numbers = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1]])  # pixel centres
    sphere = np.diag([SCALE] * 3 + [1.0])
    sphere[:3, 3] = center
    arrays = {f"scale_mat_{i}": sphere for i in range(VIEWS)}
    for i, pose in enumerate(w2c):
        arrays[f"world_mat_{i}"] = np.concatenate([to_whole_numbers @ K @ pose[:3], [[0, 0, 0, 1]]])
    np.savez(root / "cameras_sphere.npz", **arrays)


def transforms(root: Path, w2c: list[np.ndarray], center: np.ndarray) -> None:
    frames = [
        {"file_path": f"images/{name}", "transform_matrix": (np.linalg.inv(pose) @ OPENGL).tolist()}
        for name, pose in zip(NAMES, w2c, strict=True)
    ]
    shared = {
        "fl_x": FOCAL[0],
        "fl_y": FOCAL[1],
        "cx": PRINCIPAL[0],
        "cy": PRINCIPAL[1],
        "w": WIDTH,
        "h": HEIGHT,
    }
    (root / "transforms.json").write_text(json.dumps(shared | {"camera_model": "OPENCV", "frames": frames}))


def blender(root: Path, w2c: list[np.ndarray], center: np.ndarray) -> None:
    transforms(root, w2c, center)
    (root / "transforms.json").rename(root / "transforms_train.json")


def colmap(root: Path, w2c: list[np.ndarray], center: np.ndarray) -> None:
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(
        model="PINHOLE", width=WIDTH, height=HEIGHT, params=[*FOCAL, *PRINCIPAL], camera_id=1
    )
    model.add_camera_with_trivial_rig(camera)
    for i, (name, pose) in enumerate(zip(NAMES, w2c, strict=True)):
        image = pycolmap.Image(name=name, camera_id=1, image_id=i + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose[:3]))
    (root / "sparse").mkdir()
    model.write(root / "sparse")


def nero(root: Path, w2c: list[np.ndarray], center: np.ndarray) -> None:
    for i, pose in enumerate(w2c):
        (root / "images" / NAMES[i]).rename(root / f"{i}.exr")
        (root / f"{i}-camera.pkl").write_bytes(pickle.dumps((pose[:3], K)))


WRITERS: dict[str, Callable[[Path, list[np.ndarray], np.ndarray], None]] = {
    "neilfpp": neilfpp,
    "sfm_scene": sfm_scene,
    "dtu": dtu,
    "transforms": transforms,
    "blender": blender,
    "colmap": colmap,
    "nero": nero,
}


def test_every_layout_is_tested() -> None:
    # The cameras of `nerfactor` have their principal point in the centre: test_nerfactor.py.
    assert list(WRITERS) == [layout for layout in READERS if layout != "nerfactor"]


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("layout", WRITERS)
def test_points_project_to_known_pixels(tmp_path: Path, layout: str, world: str) -> None:
    move = WORLDS[world]
    material(tmp_path, masks=None)
    WRITERS[layout](
        tmp_path, [pose @ np.linalg.inv(move) for pose in POSES], move[:3, :3] @ CENTER + move[:3, 3]
    )
    capture = load_capture(tmp_path)
    assert capture.format == layout
    points = torch.from_numpy(POINTS @ move[:3, :3].T + move[:3, 3])
    for i, view in enumerate(capture.views):
        assert np.abs(project(view.camera, points).pixel.numpy() - pinhole_pixels(i)).max() < TOLERANCE
        # The scene frame is the world frame, shifted and scaled, so the projections are the same.
        seen = project(capture.scene_camera(view), capture.normalization.to_scene(points))
        assert np.abs(seen.pixel.numpy() - pinhole_pixels(i)).max() < TOLERANCE


@pytest.mark.parametrize("model", LENSES)
def test_every_lens_in_the_own_layout(tmp_path: Path, model: str) -> None:
    neilfpp(
        material(tmp_path, masks=None), POSES, CENTER, {"model": model, "coefficients": COEFFICIENTS[model]}
    )
    plane = pycolmap.Camera.create_from_model_name(0, model, 1.0, 1, 1)
    parameters = np.array(plane.params)
    parameters[list(plane.focal_length_idxs())] = 1.0
    parameters[list(plane.principal_point_idxs())] = 0.0
    parameters[list(plane.extra_params_idxs())] = COEFFICIENTS[model]
    plane.params = parameters
    for i, view in enumerate(load_capture(tmp_path).views):
        expected = plane.img_from_cam(local(i)) * FOCAL + PRINCIPAL
        assert (
            np.abs(project(view.camera, torch.from_numpy(POINTS)).pixel.numpy() - expected).max() < TOLERANCE
        )
