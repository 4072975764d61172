"""A dense oriented point cloud of posed images, computed on the CPU: one depth map per view, fused."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from neilfpp_method.data.cameras.neighbors import choose_sources
from neilfpp_method.data.capture import Capture
from neilfpp_method.data.files.images import read_image, write_exr
from neilfpp_method.data.point_cloud import WorldPoints
from neilfpp_method.errors import UserError
from neilfpp_method.prepare.depth_fusion import DepthMap, fuse_depth_maps
from neilfpp_method.prepare.plane_sweep import gray_view, inverse_depth_step, sweep
from neilfpp_method.prepare.progress import Bars
from neilfpp_method.prepare.sparse_cloud import without_outliers

__all__ = ["dense_cloud"]

STEREO_SOURCES = 4
"""Number of views that a view is compared with to compute its depth map. The time grows in proportion."""

FUSION_SOURCES = 8
"""Number of views whose depth maps may confirm a depth of a view. A look-up is cheap, so there are more of
them than views in the comparison of images."""


def dense_cloud(capture: Capture, folder: Path, open_bar: Bars) -> WorldPoints:
    """Compute an oriented point cloud of a capture by plane-sweep stereo, in the world frame.

    Args:
        capture: posed images with a scene box.
        folder: folder of the depth maps, `NAME.exr`. An existing depth map is read instead of computed again.
        open_bar: opens a progress bar with a title and a total.

    Raises:
        UserError: no two views are close enough to be compared, or the depth maps agree nowhere.
    """
    views = [gray_view(view, capture.hdr) for view in capture.views]
    cameras = [view.camera for view in views]
    center = np.array(capture.normalization.center)
    sources = choose_sources(cameras, center, STEREO_SOURCES)
    if not any(sources):
        raise UserError(f"{capture.root}: no two views see the scene from nearby", "use --cloud sparse")
    bar = open_bar("depth of each view", len(views))
    depths = []
    for view, reference, others in zip(capture.views, views, sources, strict=True):
        path = folder / f"{view.name}.exr"
        if not path.is_file():
            write_exr(path, {"Z": sweep(reference, [views[j] for j in others], capture.normalization)})
        depths.append(read_image(path).pixels[..., 0])
        bar.advance()
    steps = [
        inverse_depth_step(camera, [cameras[j] for j in others])
        for camera, others in zip(cameras, sources, strict=True)
    ]
    neighbors = choose_sources(cameras, center, FUSION_SOURCES)
    maps = [DepthMap(*of_view) for of_view in zip(cameras, depths, steps, neighbors, strict=True)]
    points = fuse_depth_maps(maps, open_bar("fusing depth", len(views)).advance)
    if not len(points.position):
        raise UserError(
            f"{capture.root}: the depth maps of the views agree on no surface",
            "use --cloud sparse: stereo needs texture",
        )
    return without_outliers(points)
