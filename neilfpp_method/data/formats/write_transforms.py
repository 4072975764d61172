"""Writer of nerfstudio's transforms.json; `transforms` reads it back, with box, response and validity."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from neilfpp_method.data.cameras.camera import Camera
from neilfpp_method.data.capture import Capture
from neilfpp_method.data.files.json_entry import write_json
from neilfpp_method.data.formats.copies import copy_file, copy_view, writing
from neilfpp_method.data.formats.nerfstudio_lens import FISHEYE, nerfstudio_coefficients
from neilfpp_method.data.formats.transforms import FLIP
from neilfpp_method.data.views import View

__all__ = ["write_transforms"]


def write_transforms(capture: Capture, out: Path) -> Path:
    """Write a capture with copies of its images, masks and points, and return the folder.

    The world frame does not change. Lenses that nerfstudio supports are kept. Images of other lenses, and of
    fisheyes in a capture that has other cameras as well, are resampled. Nerfstudio ignores the entries
    `scene`, `response` and `valid_path`.

    Raises:
        UserError: an image cannot be read, or the folder cannot be written.
    """
    fisheye = all(
        view.camera.lens is not None and view.camera.lens.model == FISHEYE for view in capture.views
    )
    with writing(out):
        views = [
            copy_view(view, out, capture.hdr, straight=not _known(view.camera, fisheye))
            for view in capture.views
        ]
        description: dict[str, Any] = {
            "camera_model": FISHEYE if fisheye else "OPENCV",
            "response": "linear" if capture.hdr else "srgb",
            "scene": {"centre": list(capture.normalization.center), "radius": capture.normalization.scale},
        }
        if capture.point_cloud is not None:
            cloud = copy_file(capture.point_cloud, out / "points.ply")
            description["ply_file_path"] = cloud.name
        if capture.test:
            # If there is a list for one split, nerfstudio requires one for every split.
            test = [_listed(out, view.image) for view in views if view.name in capture.test]
            train = [_listed(out, view.image) for view in views if view.name not in capture.test]
            description |= {"train_filenames": train, "val_filenames": test, "test_filenames": test}
        description["frames"] = [_frame(out, view) for view in views]
        write_json(out / "transforms.json", description)
    return out


def _known(camera: Camera, fisheye: bool) -> bool:
    bent = camera.lens is not None and camera.lens.model == FISHEYE
    return nerfstudio_coefficients(camera) is not None and bent == fisheye


def _frame(out: Path, view: View) -> dict[str, Any]:
    camera = view.camera
    c2w = np.concatenate([camera.c2w * FLIP, [[0.0, 0.0, 0.0, 1.0]]])
    files = {"mask_path": view.mask, "valid_path": view.valid}
    return {
        "file_path": _listed(out, view.image),
        **{name: _listed(out, path) for name, path in files.items() if path},
        **{"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy},
        **{"w": camera.width, "h": camera.height},
        **(nerfstudio_coefficients(camera) or {}),
        "transform_matrix": c2w.tolist(),
    }


def _listed(out: Path, path: Path) -> str:
    return path.relative_to(out).as_posix()
