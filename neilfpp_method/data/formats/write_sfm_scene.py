"""Writer of the layout in which the NeILF datasets are published; `sfm_scene` reads it back."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from neilfpp_method.data.capture import Capture
from neilfpp_method.data.files.json_entry import write_json
from neilfpp_method.data.formats.copies import copy_file, copy_view, writing

__all__ = ["write_sfm_scene"]


def write_sfm_scene(capture: Capture, out: Path) -> Path:
    """Write a capture with copies of its images, masks and points, and return the folder.

    The layout has pinhole cameras only, so images of a lens are resampled.

    Raises:
        UserError: an image cannot be read, or the folder cannot be written.
    """
    inputs = out / "inputs"
    with writing(out):
        views = [copy_view(view, inputs, capture.hdr, straight=True) for view in capture.views]
        if capture.point_cloud is not None:
            copy_file(capture.point_cloud, inputs / "model" / "oriented_pcd.ply")
        tracks, files = {}, {}
        for i, view in enumerate(views):
            camera = view.camera
            intrinsic = {"focal": [camera.fx, camera.fy], "ppt": [camera.cx, camera.cy]}
            tracks[str(i)] = {
                "flg": 2,
                "size": [camera.width, camera.height],
                "camera": {"intrinsic": intrinsic, "extrinsic": camera.w2c.reshape(-1).tolist()},
            }
            files[str(i)] = view.image.relative_to(inputs).as_posix()
        box = np.diag([2 * capture.normalization.scale] * 3 + [1.0])
        box[:3, 3] = capture.normalization.center
        scene = {
            "camera_track_map": {"images": tracks},
            "image_path": {"file_paths": files},
            "bbox": {"transform": box.reshape(-1).tolist()},
        }
        write_json(out / "split.json", {"test": [view.name for view in capture.test_views]})
        write_json(inputs / "sfm_scene.json", scene)
    return out
