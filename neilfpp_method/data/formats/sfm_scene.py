"""Reader of the layout of the published NeILF datasets: `inputs/sfm_scene.json` and the files beside it.

    camera_track_map.images.<i>.flg                 2 for a valid camera; others are left out
    camera_track_map.images.<i>.size                width, height in pixels
    camera_track_map.images.<i>.camera.intrinsic    focal (1 or 2 numbers), ppt (principal point), pixels
    camera_track_map.images.<i>.camera.extrinsic    world to camera, 4×4, row-major
    image_path.file_paths.<i>                       the image, relative to the folder `inputs`
    bbox.transform                                  4×4: full extents on the diagonal, centre in column 4
    inputs/masks/<stem>.*                           optional: masks
    inputs/model/oriented_pcd.ply                   optional: oriented point cloud
    inputs/valid/<stem>.*                           optional: validity masks, written by `write_sfm_scene`

Other entries are ignored.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from neilfpp_method.data.cameras.camera import Camera
from neilfpp_method.data.files.images import IMAGE_SUFFIXES
from neilfpp_method.data.files.json_entry import Entry
from neilfpp_method.data.files.paths import inside
from neilfpp_method.data.formats.places import check_masks, stored, stored_image
from neilfpp_method.data.point_cloud import read_oriented_ply
from neilfpp_method.data.views import CaptureFiles, Normalization, View
from neilfpp_method.errors import UserError

__all__ = ["LAYOUT", "read", "recognize"]

LAYOUT = "inputs/sfm_scene.json"
PLACES = ("inputs/sfm_scene.json", "sfm_scene.json", "inputs/model/sfm_scene.json")
POINT_CLOUD = "model/oriented_pcd.ply"
VALID_FLAG = 2
"""Value of `flg` of a camera with a valid pose."""


def recognize(root: Path) -> bool:
    """Whether the folder has a scene file where this layout puts it."""
    return any((root / place).is_file() for place in PLACES)


def read(root: Path) -> CaptureFiles:
    """Read the files of the capture.

    Raises:
        UserError: the scene file is malformed, or images and cameras do not match; names the file and the
            entry.
    """
    path = inside(root, next(root / place for place in PLACES if (root / place).is_file()))
    scene = Entry.load(path)
    tracks, files = scene["camera_track_map"]["images"], scene["image_path"]["file_paths"]
    for key in files.entries():
        if key not in tracks.entries():
            raise UserError(
                f"{files.name(key)}: an image without a camera", "add its camera, or remove the entry"
            )
    valid = sorted(
        (key for key in tracks.entries() if tracks[key]["flg"].value == VALID_FLAG), key=_number_of(tracks)
    )
    for key in valid:
        if key not in files.entries():
            raise UserError(
                f"{tracks.name(key)}: a camera without an image", f"add its image to {files.where}"
            )
    if not valid:
        raise UserError(
            f"{path}: no images with a valid camera", f"give at least one entry the flg {VALID_FLAG}"
        )
    listed = {key: files[key].text() for key in files.entries()}
    inputs = _inputs_folder(root, path, listed[valid[0]])
    views = tuple(_view(root, inputs, int(key), tracks[key], files[key]) for key in valid)
    check_masks(inputs / "masks", views)
    _refuse_strays(views, {Path(name).stem for name in listed.values()}, path)
    cloud = inputs / POINT_CLOUD
    point_cloud = inside(root, cloud) if cloud.is_file() else None
    return CaptureFiles(inputs, views, _normalization(scene, point_cloud), point_cloud)


def _number_of(tracks: Entry) -> Callable[[str], int]:
    def number(key: str) -> int:
        try:
            return int(key)
        except ValueError:
            raise UserError(
                f"{tracks.name(key)}: an image's key is not a number", "number the images from 0"
            ) from None

    return number


def _view(root: Path, inputs: Path, index: int, track: Entry, file: Entry) -> View:
    width, height = track["size"].numbers((2,))
    if (width, height) != (int(width), int(height)):
        raise UserError(
            f"{track.name('size')}: the image size is not whole", "give width and height in pixels"
        )
    intrinsic, extrinsic = track["camera"]["intrinsic"], track["camera"]["extrinsic"]
    fx, fy = np.broadcast_to(intrinsic["focal"].numbers((), (1,), (2,)), 2)
    cx, cy = intrinsic["ppt"].numbers((2,))
    w2c = extrinsic.numbers((16,), (4, 4)).reshape(4, 4)
    camera = Camera(float(fx), float(fy), float(cx), float(cy), int(width), int(height), w2c)
    image = stored_image(root, inputs / file.text(), file.where)
    mask, valid = (stored(root, inputs / folder / f"{image.stem}.png") for folder in ("masks", "valid"))
    return View(image.stem, index, camera, image, mask, valid)


def _inputs_folder(root: Path, scene: Path, listed: str) -> Path:
    """The folder that listed paths start from, found by the first image: the scene file may lie elsewhere."""
    folders = (scene.parent, root / "inputs", root)
    return next((folder for folder in folders if stored(root, folder / listed) is not None), scene.parent)


def _refuse_strays(views: tuple[View, ...], listed: set[str], scene: Path) -> None:
    """Images beside the listed ones that the scene file lacks: a user may believe that they are used."""
    for folder in sorted({view.image.parent for view in views}):
        for file in sorted(folder.iterdir()):
            is_image = file.suffix.lower() in IMAGE_SUFFIXES and not file.name.startswith(".")
            if is_image and file.stem not in listed:
                raise UserError(
                    f"{file}: an image without a camera in {scene}", "add its camera, or move it away"
                )


def _normalization(scene: Entry, point_cloud: Path | None) -> Normalization:
    """The centre, and half of the largest extent, of the box; without a box, of the point cloud."""
    if "bbox" in scene.entries():
        entry = scene["bbox"]["transform"]
        box = entry.numbers((16,), (4, 4)).reshape(4, 4)
        extents, center, where = np.diagonal(box)[:3], box[:3, 3], entry.where
    elif point_cloud is not None:
        points = read_oriented_ply(point_cloud).position
        low, high = points.min(axis=0), points.max(axis=0)
        extents, center, where = high - low, (low + high) / 2, str(point_cloud)
    else:
        raise UserError(
            f"{scene.where}: no bbox and no {POINT_CLOUD}", "add one: it says where the object is"
        )
    if extents.min() < 0 or extents.max() == 0:
        raise UserError(f"{where}: the box is empty or inside out", "give the full extents on the diagonal")
    return Normalization(float(extents.max() / 2), tuple(map(float, center)))
