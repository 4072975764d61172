"""Reader of COLMAP models, text or binary, with or without rigs, and with any camera model but panoramas.

    sparse/0, sparse, … or the folder itself    cameras, images, points3D (.bin or .txt); of several models
                                                  sparse/0, sparse/1, … the largest
    images/, or beside the model                the images; an EXR file may replace a listed image; images
                                                  that do not exist are left out
    masks/<image>.png or masks/<stem>.png       optional: masks; the folder may also be called mask
    fused.ply or dense/fused.ply                optional: COLMAP's dense points with normals
    object_point_cloud.ply                      optional: points of the object only, from which the scene box
                                                  is computed (NeRO's scenes)

Images are used as they are: a lens keeps its distortion, and rays are bent instead of the image.
"""

from __future__ import annotations

from collections.abc import Sequence
from glob import escape
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from neilfpp_method.data.cameras.camera import Camera
from neilfpp_method.data.cameras.colmap_library import pycolmap
from neilfpp_method.data.cameras.lens import PANORAMAS, lens_of
from neilfpp_method.data.files.paths import inside
from neilfpp_method.data.formats.colmap_sizes import check_sizes
from neilfpp_method.data.formats.places import check_masks, stored, stored_images, view_names
from neilfpp_method.data.point_cloud import read_positions
from neilfpp_method.data.scene_box import find_box
from neilfpp_method.data.views import CaptureFiles, View
from neilfpp_method.errors import UserError

__all__ = ["LAYOUT", "camera_of", "model_folder", "open_model", "read", "recognize"]

LAYOUT = "a COLMAP model in sparse/0, sparse or the folder itself"
NUMBERED = ("sparse", "colmap/sparse")
"""Folders in which COLMAP's mapper writes one or more models: 0, 1, …"""
MODELS = ("sparse", ".", "dense/sparse", "dense/0/sparse")
MASK_FOLDERS = ("masks", "mask")
IMAGE_FOLDERS = ("images", "dense/images", "dense/0/images", ".")
OBJECT = "object_point_cloud.ply"
POINT_CLOUDS = ("fused.ply", "dense/fused.ply", "dense/0/fused.ply")
FILES = ("cameras", "images", "points3D")


def recognize(root: Path) -> bool:
    """Whether the folder has a complete model in one of the places in which COLMAP's tools write it."""
    return model_folder(root) is not None


def read(root: Path) -> CaptureFiles:
    """Read the files of the capture: one view for each registered image that exists, in the order of names.

    Raises:
        UserError: the model is malformed or empty, has a panorama, most images are missing, or one is outside
            the folder.
    """
    folder = model_folder(root)
    if folder is None:
        raise UserError(f"{root}: no COLMAP model", f"it needs {LAYOUT}")
    for file in sorted(folder.iterdir()):
        inside(root, file)
    model = open_model(folder)
    registered = sorted((model.image(i) for i in model.reg_image_ids()), key=lambda image: image.name)
    if not registered:
        raise UserError(f"{folder}: the model has no registered image", "reconstruct the cameras again")
    # A model that was written on Windows may have its separators.
    names = [image.name.replace("\\", "/") for image in registered]
    inputs = _image_folder(root, names)
    if inputs is None:
        first = names[0]
        _check_spaces(root, folder, first)
        _check_reduced(root, first)
        raise UserError(
            f"{root}: there is no images/{first}", "put the images of the model into the folder images"
        )
    masks = next((root / name for name in MASK_FOLDERS if (root / name).is_dir()), root / MASK_FOLDERS[0])
    files = stored_images(root, [inputs / name for name in names], str(folder))
    described = tuple(zip(registered, names, files, strict=True))
    existing = [(image, listed, file) for image, listed, file in described if file]
    view_name = view_names([listed for _, listed, _ in existing])
    views = []
    for index, (image, listed, file) in enumerate(existing):
        w2c = np.concatenate([image.cam_from_world().matrix(), [[0.0, 0.0, 0.0, 1.0]]])
        camera = camera_of(image.camera, w2c, f"{folder}: {listed}")
        views.append(View(view_name[index], index, camera, file, _mask(masks, root, listed)))
    check_masks(masks, views)
    if (root / OBJECT).is_file():
        points = read_positions(inside(root, root / OBJECT))
    else:
        points = np.array([p.xyz for p in model.points3D.values()]).reshape(-1, 3)
    cloud = next((inside(root, root / place) for place in POINT_CLOUDS if (root / place).is_file()), None)
    box = find_box(views, points[np.isfinite(points).all(axis=1)])
    return CaptureFiles(
        inputs=inputs,
        views=tuple(views),
        normalization=box.normalization,
        point_cloud=cloud,
        scene_from=box.source,
        missing=tuple(listed for _, listed, file in described if file is None),
    )


def _image_folder(root: Path, names: Sequence[str]) -> Path | None:
    """The first folder that has at least one of the images."""
    folders = (root / place for place in IMAGE_FOLDERS)
    return next((folder for folder in folders if any(stored(root, folder / name) for name in names)), None)


def open_model(folder: Path) -> pycolmap.Reconstruction:
    """Read a model with pycolmap.

    Raises:
        UserError: it is malformed or cut off.
    """
    try:
        check_sizes(folder)
        model = pycolmap.Reconstruction(folder)
        for i in model.reg_image_ids():
            # Raises if a frame names an image that is not there, or if a name is not UTF-8.
            model.image(i).name  # noqa: B018
        return model
    except (ValueError, IndexError, RuntimeError, MemoryError, OSError) as error:
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise UserError(
            f"{folder}: not a COLMAP model that can be read ({reason})", "export the model again"
        ) from error


def camera_of(camera: pycolmap.Camera, w2c: Float64[np.ndarray, "4 4"], where: str) -> Camera:
    """Convert a camera of pycolmap with a pose; a lens without distortion becomes a pinhole.

    Args:
        camera: a camera of any model but panoramas.
        w2c: the pose, world to camera.
        where: the image, for the message.

    Raises:
        UserError: the camera is a panorama, which has no image plane.
    """
    if camera.model_name in PANORAMAS:
        raise UserError(
            f"{where}: a camera of the model {camera.model_name}", "cut the panorama into perspective images"
        )
    params = np.asarray(camera.params, dtype=np.float64)
    fx, fy = np.broadcast_to(params[list(camera.focal_length_idxs())], 2)
    cx, cy = params[list(camera.principal_point_idxs())]
    lens = lens_of(camera.model_name, params[list(camera.extra_params_idxs())].tolist())
    return Camera(float(fx), float(fy), float(cx), float(cy), camera.width, camera.height, w2c, lens)


def model_folder(root: Path) -> Path | None:
    """Return the folder of the complete model; None if there is none.

    COLMAP writes several models if it cannot connect all images. The largest of them is used, which is not
    always the first.
    """
    for place in NUMBERED:
        numbered = [folder for folder in (root / place).glob("[0-9]*") if _model_files(folder)]
        if numbered:
            return max(sorted(numbered), key=lambda folder: _model_size(root, folder))
    return next((root / place for place in MODELS if _model_files(root / place)), None)


def _check_spaces(root: Path, model: Path, first: str) -> None:
    """Raise a `UserError` if a text model has cut off the name of its first image at a space."""
    is_text = _model_files(model)[0].suffix == ".txt"
    whole = [file for place in IMAGE_FOLDERS for file in (root / place).glob(f"{escape(first)} *")]
    if is_text and whole:
        raise UserError(
            f"{model}: names of images end at their first space in a text model, as {first!r}",
            "export the model as binary, or rename the images and reconstruct again",
        )


def _check_reduced(root: Path, first: str) -> None:
    """Raise a `UserError` if there are only reduced copies of the images, as of mip-NeRF 360."""
    for folder in sorted(root.glob("images_[1-9]")):
        if stored(root, folder / first):
            raise UserError(
                f"{root}: there is no images/{first}, only {folder.name}, which the cameras do not fit",
                "put the full images into the folder images, and train on reduced ones with "
                f"--scale {1 / int(folder.name[-1]):.3g}",
            )


def _model_files(folder: Path) -> list[Path]:
    """The files of a model, binary if there are both; empty if it is not complete."""
    for suffix in (".bin", ".txt"):
        files = [folder / f"{name}{suffix}" for name in FILES]
        if all(file.is_file() for file in files):
            return files
    return []


def _model_size(root: Path, folder: Path) -> int:
    """Size of the file of the images, which grows with their number and that of their points, in bytes."""
    return inside(root, _model_files(folder)[1]).stat().st_size


def _mask(masks: Path, root: Path, image: str) -> Path | None:
    """The mask of an image: <image>.png, COLMAP's own convention, or <stem>.png, that of other tools."""
    named = masks / f"{image}.png"
    return named if inside(root, named).is_file() else stored(root, (masks / image).with_suffix(".png"))
