"""Captures: the layouts of data sets, COLMAP models, and files beside photographs."""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from neilfpp_method.data.brackets.folder import find_brackets
from neilfpp_method.data.brackets.photo_exposure import read_exposures
from neilfpp_method.data.capture import load_capture
from neilfpp_method.data.files.images import write_png
from neilfpp_method.data.formats.pickled_arrays import read_pickled_arrays
from neilfpp_method.data.pixels.dataset import PixelDataset
from tests.data.formats import test_blender, test_colmap, test_dtu, test_nerfactor, test_nero, test_transforms
from tests.data.make_capture import make_capture
from tests.data.test_capture_folder import folder as own_capture
from tests.hard_cases.hostile.readers.reader import Reader, picture

__all__ = ["CAPTURES"]


def _read_capture(folder: Path, damaged: Path) -> None:
    capture = load_capture(folder)
    inside = folder.resolve()
    for view in capture.views:
        assert view.camera.w2c.shape == (4, 4)
        assert np.isfinite(view.camera.w2c).all()
        for path in (view.image, view.mask, view.valid):
            assert path is None or path.resolve().is_relative_to(inside), f"{path} is outside the capture"
    assert capture.point_cloud is None or capture.point_cloud.resolve().is_relative_to(inside)
    assert np.isfinite(capture.normalization.scale)
    assert capture.normalization.scale > 0
    assert np.isfinite(capture.normalization.center).all()
    pixels = PixelDataset(capture, capture.views)
    batch = pixels.sample(16)
    assert batch.color.isfinite().all()
    assert batch.origins.isfinite().all()
    assert batch.directions.isfinite().all()


def _json_capture(make: Callable[[Path], object], *names: str) -> Callable[[Path], list[Path]]:
    def made(folder: Path) -> list[Path]:
        make(folder)
        return [folder / name for name in names]

    return made


def _colmap(text: bool) -> Callable[[Path], list[Path]]:
    def made(folder: Path) -> list[Path]:
        model = test_colmap.reconstruction(test_colmap.colmap_camera("OPENCV"))
        test_colmap.write(test_colmap.material(folder, masks=None), model, text=text)
        return sorted((folder / "sparse" / "0").iterdir())

    return made


def _nero(folder: Path) -> list[Path]:
    test_nero.scene(folder)
    arrays = (np.eye(4)[:3], np.eye(3))
    for protocol in range(pickle.HIGHEST_PROTOCOL + 1):
        (folder / f"protocol-{protocol}.pickle").write_bytes(pickle.dumps(arrays, protocol))
    return [folder / "0-camera.pkl", *sorted(folder.glob("protocol-*"))]


def _read_nero(folder: Path, damaged: Path) -> None:
    if damaged.suffix == ".pickle":
        assert all(array.dtype == np.float64 for array in read_pickled_arrays(damaged))
    else:
        _read_capture(folder, damaged)


def _groups(folder: Path) -> list[Path]:
    for name in ("a1", "a2", "b1", "b2"):
        write_png(folder / f"{name}.png", picture(3, np.uint8))
    (folder / "brackets.json").write_text(json.dumps({"a": ["a1.png", "a2.png"], "b": ["b1.png", "b2.png"]}))
    (folder / "exposures.txt").write_text("a1.png 1/60\na2.png 0.25  # long\nb1.png 1/60\nb2.png 0.25\n")
    (folder / "exposures.json").write_text(json.dumps({"a1.png": 0.1, "a2.png": "1/4"}))
    return [folder / name for name in ("brackets.json", "exposures.txt", "exposures.json")]


def _read_groups(folder: Path, damaged: Path) -> None:
    for name in ("exposures.json", "exposures.txt"):
        known = read_exposures(folder / name)
        assert all(np.isfinite(seconds) and seconds > 0 for seconds in known.values())
    for bracket in find_brackets(folder, folder / "exposures.txt").values():
        assert all(image.resolve().is_relative_to(folder.resolve()) for image in bracket)


CAPTURES: Mapping[str, Reader] = {
    "sfm_scene.json, split.json": Reader(
        _json_capture(lambda root: make_capture(root, masks=True), "inputs/sfm_scene.json", "split.json"),
        _read_capture,
        0.2,
    ),
    "capture.json": Reader(_json_capture(own_capture, "capture.json"), _read_capture, 0.2),
    "transforms.json": Reader(_json_capture(test_transforms.scene, "transforms.json"), _read_capture, 0.2),
    "transforms_train.json": Reader(
        _json_capture(test_blender.scene, "transforms_train.json", "transforms_test.json"), _read_capture, 0.2
    ),
    "metadata.json (NeRFactor)": Reader(
        _json_capture(test_nerfactor.scene, *(f"{name}/metadata.json" for name in ("train_000", "test_000"))),
        _read_capture,
        0.2,
    ),
    "COLMAP, binary": Reader(_colmap(text=False), _read_capture, 0.2),
    "COLMAP, text": Reader(_colmap(text=True), _read_capture, 0.2),
    "NPZ of cameras (DTU)": Reader(_json_capture(test_dtu.scan, "cameras_sphere.npz"), _read_capture, 0.2),
    "pickle (NeRO)": Reader(_nero, _read_nero),
    "brackets and exposures": Reader(_groups, _read_groups),
}
