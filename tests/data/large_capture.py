"""A capture with many large images that is made quickly: one image file under many names."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np

from neilfpp_method.data.files.images import write_png
from tests.data.make_capture import camera_pose


def make_large_capture(root: Path, views: int, size: tuple[int, int]) -> Path:
    """The package's own layout with display values: a grey disc on a ramp, in views from all around."""
    width, height = size
    rows, columns = np.mgrid[:height, :width]
    disc = (rows - height / 2) ** 2 + (columns - width / 2) ** 2 < (0.3 * height) ** 2
    picture = np.where(disc, 180, 30 + 40 * columns // width).astype(np.uint8)
    write_png(root / "picture.png", np.repeat(picture[..., None], 3, axis=2))
    (root / "images").mkdir()
    listed = []
    for i in range(views):
        os.link(root / "picture.png", root / "images" / f"{i:03d}.png")
        camera = {
            "fx": 1.4 * height,
            "fy": 1.4 * height,
            "cx": width / 2,
            "cy": height / 2,
            "width": width,
            "height": height,
        }
        camera["w2c"] = camera_pose(i, views).tolist()
        listed.append({"name": f"{i:03d}", "image": f"images/{i:03d}.png", "camera": camera})
    capture = {"format": "neilfpp-capture", "version": 1, "response": "srgb", "views": listed}
    capture["scene"] = {"centre": [0.3, -0.2, 0.5], "radius": 1.5}
    (root / "capture.json").write_text(json.dumps(capture))
    return root
