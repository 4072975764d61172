"""NeRO's scenes: pickles that NumPy writes in every protocol, and malicious pickles."""

from __future__ import annotations

import os
import pickle
import struct
from pathlib import Path

import numpy as np
import pytest
import torch

from neilfpp_method.data.cameras.projection import project
from neilfpp_method.data.capture import load_capture
from neilfpp_method.data.formats.pickled_arrays import read_pickled_arrays
from neilfpp_method.errors import UserError
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

K = np.array([[FOCAL[0], 0, PRINCIPAL[0]], [0, FOCAL[1], PRINCIPAL[1]], [0, 0, 1]])


def scene(root: Path, protocol: int = 4, kind: type = np.float64) -> Path:
    images = material(root, masks=None, hdr=False) / "images"
    for i, pose in enumerate(POSES):
        (images / f"{i:03d}.png").rename(root / f"{i}.png")
        (root / f"{i}-depth.png").touch()
        (root / f"{i}-camera.pkl").write_bytes(pickle.dumps((pose[:3].astype(kind), K), protocol))
    return root


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_cameras_project_as_pinholes(tmp_path: Path, protocol: int, kind: type) -> None:
    capture = load_capture(scene(tmp_path, protocol, kind))
    assert capture.format == "nero"
    assert (capture.normalization.scale, capture.normalization.center) == (1.0, (0.0, 0.0, 0.0))
    assert [view.name for view in capture.views] == [str(i) for i in range(VIEWS)]
    for i, view in enumerate(capture.views):
        seen = project(view.camera, torch.from_numpy(POINTS)).pixel.numpy()
        assert np.abs(seen - pinhole_pixels(i)).max() < (1e-6 if kind is np.float64 else 1e-4)


@pytest.mark.parametrize(
    "array", [np.asfortranarray(K), K.astype(">f8"), K.astype(np.int64), K[::2, 1:], np.float32(K)]
)
@pytest.mark.parametrize("protocol", [0, 2, 4, 5])
def test_arrays_are_read_back(tmp_path: Path, array: np.ndarray, protocol: int) -> None:
    (tmp_path / "a.pkl").write_bytes(pickle.dumps([array, array], protocol))
    for read in read_pickled_arrays(tmp_path / "a.pkl"):
        assert np.array_equal(read, array)


def test_names_of_older_and_newer_numpy(tmp_path: Path) -> None:
    data = pickle.dumps((K,), 2)
    other = data.replace(b"numpy._core", b"numpy.core")
    assert (b"numpy._core" in data) != (data == other)
    for i, text in enumerate((data, other)):
        (tmp_path / f"{i}.pkl").write_bytes(text)
        assert np.array_equal(read_pickled_arrays(tmp_path / f"{i}.pkl")[0], K)


class Evil:
    def __init__(self, call, *arguments) -> None:
        self.made_by = (call, arguments)

    def __reduce__(self):
        return self.made_by


@pytest.mark.parametrize(
    ("made", "words"),
    [
        (lambda mark: pickle.dumps((Evil(os.mkdir, mark), K)), "it refers to posix.mkdir"),
        (lambda mark: pickle.dumps((Evil(np.save, mark, 0), K)), "it refers to numpy.save"),
        (lambda mark: pickle.dumps((Evil(eval, "1"), K)), "it refers to builtins.eval"),
        (lambda mark: pickle.dumps((np.array([Path(mark)], dtype=object), K)), "it refers to "),
        (lambda mark: pickle.dumps((np.array(["text"]), K)), "of another type"),
        (lambda mark: pickle.dumps((1.5, K)), "it contains something else"),
        (lambda mark: pickle.dumps({"pose": K}), "not a tuple"),
        (lambda mark: pickle.dumps((K, K))[:-20], "not pickled arrays"),
        (lambda mark: pickle.dumps((np.zeros(20_000), K)), "too large for a camera"),
        (lambda mark: b"\x80\x02Nr" + struct.pack("<I", 2**32 - 1) + b".", "damaged"),
        (lambda mark: b"\x80\x05\x96" + struct.pack("<Q", 2**40) + b"abc.", "not pickled arrays"),
        (lambda mark: b"", "not pickled arrays"),
        (
            lambda mark: pickle.dumps((K, K), 2).replace(b"K\x03K\x03\x86", b"K\x03K\x09\x86"),
            "not pickled arrays",
        ),
    ],
)
def test_anything_but_arrays_is_refused_without_running_code(tmp_path: Path, made, words: str) -> None:
    mark = tmp_path / "mark"
    (tmp_path / "a.pkl").write_bytes(made(str(mark)))
    with pytest.raises(UserError, match=rf"a\.pkl.*{words}"):
        read_pickled_arrays(tmp_path / "a.pkl")
    assert not mark.exists()


def test_bad_scenes_are_refused(tmp_path: Path) -> None:
    root = scene(tmp_path / "capture")
    camera = root / "2-camera.pkl"
    good = camera.read_bytes()
    camera.write_bytes(pickle.dumps((K, K)))
    refused(root, "2-camera.pkl: not a pose of 3×4")
    camera.write_bytes(pickle.dumps((POSES[2][:3], K + np.eye(3)[[1, 0, 2]])))
    refused(root, "2-camera.pkl: the intrinsics are not those of a pinhole")
    camera.write_bytes(pickle.dumps((2 * POSES[2][:3], K)))
    refused(root, "2.png: the extrinsic matrix is not a rotation")
    camera.write_bytes(good)
    (root / "3.png").rename(tmp_path / "3.png")
    refused(root, "there is no", "3.png")
    (root / "3.png").symlink_to(tmp_path / "3.png")
    refused(root, "not a path within the capture")
    (root / "3.png").unlink()
    (root / "3-camera.pkl").unlink()
    refused(root, "3-camera.pkl")
