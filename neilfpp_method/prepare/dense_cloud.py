"""A dense oriented cloud from posed images, on the CPU: a depth map for each view, and what they agree on."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from neilfpp_method.data.capture import Capture
from neilfpp_method.data.images import read_image, write_exr
from neilfpp_method.data.point_cloud import WorldPoints
from neilfpp_method.errors import UserError
from neilfpp_method.prepare.depth_fusion import fuse
from neilfpp_method.prepare.plane_sweep import choose_sources, grain, grey_view, sweep
from neilfpp_method.prepare.progress import Bars
from neilfpp_method.prepare.sparse_cloud import without_outliers

__all__ = ["dense_cloud"]

SWEPT, ASKED = 4, 8


def dense_cloud(capture: Capture, folder: Path, open_bar: Bars) -> WorldPoints:
    """The oriented points of a capture by plane-sweep stereo, in the world frame.

    Args:
        capture: posed images with a scene box.
        folder: where depth maps are kept, `NAME.exr`; those that are there are not computed again.
        open_bar: for the progress.

    Raises:
        UserError: no two views are close enough to be compared, or nothing in them agrees.
    """
    views = [grey_view(view, capture.hdr) for view in capture.views]
    cameras = [view.camera for view in views]
    centre = np.array(capture.normalisation.centre)
    sources = choose_sources(cameras, centre, SWEPT)
    if not any(sources):
        raise UserError(f"{capture.root}: no two views see the scene from nearby", "leave out --dense")
    bar = open_bar("depth of each view", len(views))
    depths = []
    for view, grey, others in zip(capture.views, views, sources, strict=True):
        path = folder / f"{view.name}.exr"
        if not path.is_file():
            write_exr(path, {"Z": sweep(grey, [views[j] for j in others], capture.normalisation)})
        depths.append(read_image(path).pixels[..., 0])
        bar.advance()
    grains = [
        grain(camera, [cameras[j] for j in others]) for camera, others in zip(cameras, sources, strict=True)
    ]
    asked = choose_sources(cameras, centre, ASKED)
    points = fuse(cameras, depths, grains, asked, open_bar("fusing depth", len(views)).advance)
    if not len(points.position):
        raise UserError(
            f"{capture.root}: the views agree on no surface", "leave out --dense; stereo needs texture"
        )
    return without_outliers(points)
