"""Photographs with poses, from structure from motion or from an existing capture."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from neilfpp_method.data.cameras.colmap_library import pycolmap
from neilfpp_method.data.capture import Capture
from neilfpp_method.data.files.images import read_image, write_exr, write_png
from neilfpp_method.data.files.raw import RAW_SUFFIXES
from neilfpp_method.data.formats.colmap import camera_of
from neilfpp_method.data.formats.copies import copy_view
from neilfpp_method.data.views import Normalization, SceneSource, View
from neilfpp_method.prepare.matching_copies import relative_exposures
from neilfpp_method.prepare.photos import Photos, read_photo

__all__ = ["Posed", "posed_by_capture", "posed_by_model", "write_views"]


@dataclass(frozen=True)
class Posed:
    """Views whose files are still in their original place.

    Attributes:
        views: the views, in the world frame.
        linear: whether pixels are linear radiance.
        normalization: the scene's sphere, if the capture states it.
        cloud: oriented point cloud of the capture, if it has one.
        test: names of the test views, if the capture states them.
        scene_from: where `normalization` comes from.
    """

    views: tuple[View, ...]
    linear: bool
    normalization: Normalization | None = None
    cloud: Path | None = None
    test: frozenset[str] | None = None
    scene_from: SceneSource = "box"


def posed_by_model(photos: Photos, model: pycolmap.Reconstruction) -> Posed:
    """Return the photographs that a model of structure from motion places, in the order of `photos`."""
    poses = {model.image(i).name.removesuffix(".png"): model.image(i) for i in model.reg_image_ids()}
    exposures = relative_exposures(photos)
    views = []
    for photo in photos.items:
        if (image := poses.get(photo.name)) is not None:
            w2c = np.concatenate([image.cam_from_world().matrix(), [[0.0, 0.0, 0.0, 1.0]]])
            camera = camera_of(image.camera, w2c, str(photo.path))
            views.append(
                View(photo.name, len(views), camera, photo.path, None, photo.valid, exposures[photo.name])
            )
    return Posed(tuple(views), photos.linear)


def posed_by_capture(capture: Capture) -> Posed:
    """Return the views of a capture, with its scene box unless that was guessed from the cameras."""
    known = capture.normalization if capture.scene_from != "cameras" else None
    return Posed(capture.views, capture.hdr, known, capture.point_cloud, capture.test, capture.scene_from)


def write_views(posed: Posed, folder: Path, undistort: bool, advance: Callable[[], None]) -> tuple[View, ...]:
    """Copy the files of all views to `folder`/images, `folder`/masks and `folder`/valid.

    RAW files and images with invalid pixels are converted to EXR with a validity mask.

    Args:
        posed: the views.
        folder: the target folder.
        undistort: whether to resample images to pinhole cameras.
        advance: called once per view.

    Returns:
        The views with the copied files.

    Raises:
        UserError: an image cannot be read.
    """
    written = []
    for view in posed.views:
        written.append(copy_view(_usable(view, folder / "developed"), folder, posed.linear, undistort))
        advance()
    return tuple(written)


def _usable(view: View, developed: Path) -> View:
    """The view, converted to EXR with a validity mask if its image is RAW or has invalid pixels."""
    picture = read_photo(view.image)
    if picture.valid.all() and view.image.suffix.lower() not in RAW_SUFFIXES:
        return view
    image, valid = developed / f"{view.name}.exr", developed / f"{view.name}-valid.png"
    if picture.alpha is None:
        write_exr(image, {"RGB": picture.pixels})
    else:
        write_exr(image, {"RGBA": np.concatenate([picture.pixels, picture.alpha[..., None]], axis=-1)})
    usable = picture.valid
    if view.valid is not None:
        usable = usable & (read_image(view.valid).mask > 0.5)
    write_png(valid, np.where(usable, 255, 0).astype(np.uint8))
    return replace(view, image=image, valid=valid)
