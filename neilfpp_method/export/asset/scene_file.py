"""The description of an asset's scene that its scripts read: files, cameras and lamps, in the world frame."""

from __future__ import annotations

from typing import Any

import numpy as np

from neilfpp_method.data.views import View
from neilfpp_method.export.light import lamps_in_world
from neilfpp_method.train.run import Run

__all__ = ["describe_scene"]

FORMAT = 1
"""Version of the format of scene.json."""


def describe_scene(run: Run, environment: bool) -> dict[str, Any]:
    """Build the contents of `scene.json` (docs/assets.md).

    Args:
        run: the run.
        environment: whether the asset has an environment map.
    """
    maps = {
        "ours": "environment.exr",
        "blender": "environment_blender.exr",
        "unreal": "environment_unreal.exr",
    }
    return {
        "format": FORMAT,
        "frame": "world of the capture, right-handed, Z up",
        "environment": maps if environment else None,
        "lamps": lamps_in_world(run),
        "cameras": [
            _camera(view, "test" if view.name in run.capture.test else "train") for view in run.capture.views
        ],
    }


def _camera(view: View, split: str) -> dict[str, Any]:
    """A camera with focal lengths and principal point in pixels and OpenCV axes.

    The distortion of a lens is not described; only the name of its model is.
    """
    camera = view.camera
    return {
        "name": view.name,
        "split": split,
        "width": camera.width,
        "height": camera.height,
        "fx": camera.fx,
        "fy": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        "lens": None if camera.lens is None else camera.lens.model,
        "camera_to_world": np.concatenate([camera.c2w, [[0.0, 0.0, 0.0, 1.0]]]).tolist(),
    }
