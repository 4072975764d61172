"""The layout of IDR and NeuS: projection matrices of any scale and sign, and the unit sphere from the scale
matrices.
"""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from neilfpp_method.data.cameras.projection import project
from neilfpp_method.data.capture import load_capture
from tests.data.formats.scenes import (
    FOCAL,
    POINTS,
    POSES,
    PRINCIPAL,
    VIEWS,
    material,
    pinhole_pixels,
    refused,
)
from tests.data.make_capture import CENTER, SCALE

# Pixel centres have integer coordinates in these files.
K = np.array([[FOCAL[0], 0, PRINCIPAL[0] - 0.5], [0, FOCAL[1], PRINCIPAL[1] - 0.5], [0, 0, 1]])


def matrices(factor: float = 1.0) -> dict[str, np.ndarray]:
    arrays = {}
    for i, pose in enumerate(POSES):
        arrays[f"world_mat_{i}"] = np.eye(4)
        arrays[f"world_mat_{i}"][:3] = factor * K @ pose[:3]
        arrays[f"scale_mat_{i}"] = np.diag([SCALE, SCALE, SCALE, 1.0])
        arrays[f"scale_mat_{i}"][:3, 3] = CENTER
        arrays[f"world_mat_inv_{i}"] = np.linalg.inv(arrays[f"world_mat_{i}"])
    return arrays


def scan(
    root: Path, folder: str = "image", archive: str = "cameras_sphere.npz", hdr: bool = True, **changes
) -> Path:
    material(root, folder, "mask", hdr)
    np.savez(root / archive, **{**matrices(), **changes})
    return root


@pytest.mark.parametrize("factor", [1.0, 0.01, -7.0])
@pytest.mark.parametrize(("folder", "archive"), [("image", "cameras_sphere.npz"), ("rgb", "cameras.npz")])
def test_projection_matrices(tmp_path: Path, factor: float, folder: str, archive: str) -> None:
    capture = load_capture(scan(tmp_path, folder, archive, **matrices(factor)))
    assert capture.format == "dtu"
    assert len(capture.views) == VIEWS
    for i, view in enumerate(capture.views):
        assert (
            np.abs(project(view.camera, torch.from_numpy(POINTS)).pixel.numpy() - pinhole_pixels(i)).max()
            < 1e-6
        )
        expected = cv2.projectPoints(
            POINTS, *map(np.ascontiguousarray, (POSES[i][:3, :3], POSES[i][:3, 3])), K, None
        )[0]
        assert np.abs(pinhole_pixels(i) - 0.5 - expected[:, 0]).max() < 1e-6
        assert view.mask == tmp_path / "mask" / f"{i:03d}.png"


def test_the_scale_matrix_is_the_scene_frame(tmp_path: Path) -> None:
    normalization = load_capture(scan(tmp_path)).normalization
    assert normalization.scale == SCALE
    assert normalization.center == tuple(CENTER)


def test_masks_are_assigned_by_order_if_names_differ(tmp_path: Path) -> None:
    scan(tmp_path)
    for i in range(VIEWS):
        (tmp_path / "image" / f"{i:03d}.exr").rename(tmp_path / "image" / f"rect_{i:03d}.exr")
    assert [view.mask.stem for view in load_capture(tmp_path).views] == [f"{i:03d}" for i in range(VIEWS)]


def skewed() -> np.ndarray:
    k = K.copy()
    k[0, 1] = 0.5
    return np.vstack([k @ POSES[0][:3], [0, 0, 0, 1]])


def turned_sphere() -> np.ndarray:
    matrix = np.eye(4)
    matrix[:2, :2] = [[0, -1], [1, 0]]
    return matrix


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"world_mat_0": np.zeros((4, 4))}, "world_mat_0 is not a projection matrix"),
        ({"world_mat_0": np.full((4, 4), np.nan)}, "world_mat_0 is not a 4×4 matrix"),
        ({"world_mat_0": np.eye(3)}, "world_mat_0 is not a 4×4 matrix"),
        ({"world_mat_0": np.full((4, 4), "x")}, "world_mat_0 is not a 4×4 matrix"),
        ({"world_mat_0": np.array([{}], dtype=object)}, "not an archive of matrices"),
        ({"world_mat_0": skewed()}, "pixels that are not rectangular"),
        ({"world_mat_6": np.eye(4)}, "7 cameras for 6 images and 6 masks"),
        ({"scale_mat_0": turned_sphere()}, "scale_mat_0 is not a scale and a shift"),
        ({"scale_mat_3": 2 * np.eye(4)}, "the scale matrices differ"),
    ],
)
def test_bad_matrices_are_refused(tmp_path: Path, changes: dict, words: str) -> None:
    refused(scan(tmp_path, **changes), "cameras_sphere.npz", words)


def test_bad_archives_are_refused(tmp_path: Path) -> None:
    scan(tmp_path)
    archive = tmp_path / "cameras_sphere.npz"
    data = archive.read_bytes()
    for damaged in (b"", b"not a zip", data[: len(data) // 2]):
        archive.write_bytes(damaged)
        refused(tmp_path, "cameras_sphere.npz: not an archive of matrices")
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as bomb:
        bomb.writestr("world_mat_0.npy", bytes(2**27))
    refused(tmp_path, f"more than {2**26} bytes")
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        header, {"descr": "<f8", "fortran_order": False, "shape": (2**40, 4)}
    )
    with zipfile.ZipFile(archive, "w") as boast:
        boast.writestr("world_mat_0.npy", header.getvalue())
    refused(tmp_path, "not an archive of matrices")


def test_numbers_without_leading_zeros_are_refused(tmp_path: Path) -> None:
    scan(tmp_path)
    for i, path in enumerate(sorted((tmp_path / "image").iterdir())):
        path.rename(path.with_stem(f"{i + 7:02d}"))
    assert [view.name for view in load_capture(tmp_path).views] == ["07", "08", "09", "10", "11", "12"]
    for path in sorted((tmp_path / "image").iterdir()):
        path.rename(path.with_stem(str(int(path.stem))))
    refused(tmp_path, "12.exr comes before 7.exr, by number after it", "pad the numbers")


def test_images_and_cameras_must_match(tmp_path: Path) -> None:
    scan(tmp_path)
    (tmp_path / "image" / "002.exr").unlink()
    refused(tmp_path, "6 cameras for 5 images and 6 masks")
