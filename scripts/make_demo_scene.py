"""Make the scene that ships in the package from a larger capture in the NeILF layout.

    python scripts/make_demo_scene.py CAPTURE neilfpp_method/demo/scene

Keeps 24 training views and 4 test views, the truth of the test views, and the light field at 8 of its points.
"""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

import numpy as np

from neilfpp_method.data.capture import load_capture
from neilfpp_method.data.views import View

TRAIN_VIEWS = 24
TEST_VIEWS = 4
LIGHT_POINTS = 8


def evenly(views: tuple[View, ...], count: int) -> list[View]:
    """`count` of the views, evenly spread."""
    return [views[round(i * (len(views) - 1) / (count - 1))] for i in range(count)]


def make(source: Path, target: Path) -> None:
    """Write the reduced capture."""
    capture = load_capture(source)
    train, test = evenly(capture.train_views, TRAIN_VIEWS), evenly(capture.test_views, TEST_VIEWS)
    kept = sorted([*train, *test], key=lambda view: view.index)
    scene = json.loads((capture.inputs / "sfm_scene.json").read_text())
    numbers = [str(view.index) for view in kept]
    tracks, paths = scene["camera_track_map"]["images"], scene["image_path"]["file_paths"]
    scene["camera_track_map"]["images"] = {n: tracks[n] for n in numbers}
    scene["image_path"]["file_paths"] = {n: paths[n] for n in numbers}
    (target / "inputs").mkdir(parents=True)
    (target / "inputs" / "sfm_scene.json").write_text(json.dumps(scene))
    (target / "split.json").write_text(json.dumps({"test": [view.index for view in test]}))
    for view in kept:
        copy(view.image, target / "inputs" / "images" / view.image.name)
    for view in test:
        for folder in ("depth_maps", "normal_maps"):
            copy(
                capture.inputs / folder / f"{view.name}.exr", target / "inputs" / folder / f"{view.name}.exr"
            )
        for name in ("kd", "roughness", "metallic"):
            relative = Path("ground_truths") / "materials" / name / f"{view.name}.png"
            copy(source / relative, target / relative)
    (target / "light").mkdir()
    with np.load(source / "light" / "light_field_gt.npz", allow_pickle=False) as arrays:
        rows = np.linspace(0, len(arrays["points"]) - 1, LIGHT_POINTS).round().astype(int)
        kept_arrays = {name: arrays[name][rows] for name in arrays.files}
    kept_arrays["wi"] = kept_arrays["wi"].astype(np.float16)
    np.savez_compressed(target / "light" / "light_field_gt.npz", **kept_arrays)


def copy(source: Path, target: Path) -> None:
    """Copy a file, making the folder."""
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(source, target)


if __name__ == "__main__":
    make(Path(sys.argv[1]), Path(sys.argv[2]))
