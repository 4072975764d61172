"""Reader of nerfstudio's transforms.json, which instant-ngp and other programs write as well.

    camera_model                      OPENCV (also if missing), OPENCV_FISHEYE, or one of COLMAP's pinholes
    is_fisheye                        instant-ngp's entry for OPENCV_FISHEYE, if there is no camera_model
    fl_x, fl_y, cx, cy, w, h,         for all frames, or in a frame for that frame;
      k1 … k4, p1, p2                   camera_angle_x (radians) may replace fl_x; if a frame has an angle,
                                        the focal lengths of the file do not apply to it
    frames[].file_path                the image, relative to the file; frames without one are left out
    frames[].mask_path                optional: the mask, white on the object
    frames[].transform_matrix         camera to world, 4×4, OpenGL axes (x right, y up, z back)
    train_filenames, test_filenames   optional: the split; without test_filenames, the test views are those
                                        that train_filenames does not list
    ply_file_path                     optional: points, which are the oriented cloud if they have normals
    scene, response,                  optional, with the meaning of capture.json; written by
      frames[].valid_path               `write_transforms`

The world frame is that of the poses in the file, which is also the frame of its point cloud.
`applied_transform`, the transformation from an older frame to this one, is not undone.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from neilfpp_method.data.cameras.camera import Camera
from neilfpp_method.data.capture_folder import read_scene
from neilfpp_method.data.files.images import image_header
from neilfpp_method.data.files.json_entry import Entry
from neilfpp_method.data.files.paths import inside
from neilfpp_method.data.formats.nerfstudio_lens import COEFFICIENTS, FISHEYE, lens_from_nerfstudio
from neilfpp_method.data.formats.places import stored, stored_image, stored_images, view_names
from neilfpp_method.data.point_cloud import has_normals, read_positions
from neilfpp_method.data.scene_box import SceneBox, find_box
from neilfpp_method.data.views import CaptureFiles, View
from neilfpp_method.errors import UserError

__all__ = [
    "FLIP",
    "LAYOUT",
    "Frame",
    "Frames",
    "focal_of_angle",
    "pose_from_opengl",
    "read",
    "read_frames",
    "recognize",
]

LAYOUT = "transforms.json"
FLIP = np.array([1.0, -1.0, -1.0, 1.0])
"""Signs that convert between OpenCV's (x right, y down, z forward) and OpenGL's axes (y up, z back)."""
MODELS = ("OPENCV", FISHEYE, "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE")
"""Accepted values of `camera_model`."""


def recognize(root: Path) -> bool:
    """Whether the folder has a transforms.json."""
    return (root / LAYOUT).is_file()


def read(root: Path) -> CaptureFiles:
    """Read the files of the capture, in the order of the frames.

    Raises:
        UserError: the file is malformed, most of its images or one of its masks are missing, or a path leads
            out of the folder.
    """
    entry = Entry.load(inside(root, root / LAYOUT))
    frames = read_frames(root, entry)
    names = view_names([frame.listed for frame in frames.existing])
    views = tuple(
        View(name, i, frame.camera, frame.image, frame.mask, frame.valid)
        for i, (name, frame) in enumerate(zip(names, frames.existing, strict=True))
    )
    points = _points(root, entry)
    box = _given_box(entry) or find_box(views, points.position)
    response = entry.get("response")
    return CaptureFiles(
        inputs=root,
        views=views,
        normalization=box.normalization,
        point_cloud=points.oriented,
        test=_held_out(root, entry, views, frames.missing),
        hdr=response and response.word("linear", "srgb") == "linear",
        scene_from=box.source,
        missing=frames.missing,
    )


@dataclass(frozen=True)
class Points:
    """Positions of the points of `ply_file_path`, and its path if they have normals."""

    position: Float64[np.ndarray, "P 3"] | None
    oriented: Path | None


@dataclass(frozen=True)
class Frame:
    """An entry of `frames`.

    Attributes:
        listed: its `file_path`, as it stands in the file.
        image: the image.
        mask: mask of the object; None if there is none.
        valid: validity mask; None if there is none.
        camera: the camera, in the world frame.
    """

    listed: str
    image: Path
    mask: Path | None
    valid: Path | None
    camera: Camera


@dataclass(frozen=True)
class Frames:
    """The frames of a transforms file whose images exist, and the `file_path` of those that do not."""

    existing: tuple[Frame, ...]
    missing: tuple[str, ...]


def read_frames(root: Path, entry: Entry) -> Frames:
    """Read the frames of a transforms file.

    Raises:
        UserError: as `read`.
    """
    frames = entry["frames"].items()
    if not frames:
        raise UserError(f"{entry.where}: no frames", "export the cameras again")
    listed = [frame["file_path"].text() for frame in frames]
    images = stored_images(root, [root / name for name in listed], entry.where)
    described = tuple(zip(frames, listed, images, strict=True))
    return Frames(
        existing=tuple(_frame(root, entry, frame, name, image) for frame, name, image in described if image),
        missing=tuple(name for _, name, image in described if image is None),
    )


def _frame(root: Path, entry: Entry, frame: Entry, listed: str, image: Path) -> Frame:
    mask, valid = (
        _named(root, path) if (path := frame.get(name)) else None for name in ("mask_path", "valid_path")
    )
    return Frame(listed, image, mask, valid, _camera(entry, frame, image))


def _named(root: Path, listed: Entry) -> Path:
    return stored_image(root, root / listed.text(), listed.where)


def _camera(entry: Entry, frame: Entry, image: Path) -> Camera:
    """The camera of a frame; entries that the frame lacks are those of the file."""

    def number(name: str) -> float | None:
        value = frame.get(name) or entry.get(name)
        return value and value.number()

    header = image_header(image)
    width, height = (frame.get(name) or entry.get(name) for name in ("w", "h"))
    width, height = width.size() if width else header.width, height.size() if height else header.height
    fx, fy = _focal_lengths(entry, frame, width, height)
    cx, cy = number("cx"), number("cy")
    distortion = {name: value for name in COEFFICIENTS if (value := number(name)) is not None}
    model, fisheye = (frame.get(name) or entry.get(name) for name in ("camera_model", "is_fisheye"))
    unnamed = FISHEYE if fisheye and fisheye.value is True else "OPENCV"
    return Camera(
        fx=fx,
        fy=fy,
        cx=width / 2 if cx is None else cx,
        cy=height / 2 if cy is None else cy,
        width=width,
        height=height,
        w2c=pose_from_opengl(frame["transform_matrix"]),
        lens=lens_from_nerfstudio(_supported(model) if model else unnamed, distortion, frame.where),
    )


def _supported(model: Entry) -> str:
    if model.word() not in MODELS:
        raise UserError(
            f"{model.where}: {model.value} is not one of {', '.join(MODELS)}",
            "undistort the images, or cut panoramas into perspective images",
        )
    return model.word()


def _focal_lengths(entry: Entry, frame: Entry, width: int, height: int) -> tuple[float, float]:
    """The focal lengths of a frame, in pixels.

    As in nerfstudio, `fl_x` and `fl_y` stand in the file or in the frame, each on its own. As in instant-ngp,
    an angle of a frame replaces both focal lengths of the file. Without a vertical one, pixels are square.
    """

    def focal(place: Entry, axis: str, size: int) -> float | None:
        length, angle = place.get(f"fl_{axis}"), place.get(f"camera_angle_{axis}")
        from_angle = None if angle is None else focal_of_angle(angle, size)
        return (length and length.number()) or from_angle

    # Angles that are not used are checked as well: a wrong one may mean that the lengths are wrong, too.
    fx, fy = focal(frame, "x", width), focal(frame, "y", height)
    shared_fx, shared_fy = focal(entry, "x", width), focal(entry, "y", height)
    if (fx and not frame.get("fl_x")) or (fy and not frame.get("fl_y")):
        # At least one of them is from an angle of the frame.
        fx = fx or fy
    else:
        fx, fy = fx or shared_fx, fy or shared_fy
    if fx is None:
        raise UserError(
            f"{frame.where}: no focal length", "add fl_x, in pixels, or camera_angle_x, in radians"
        )
    return fx, fy or fx


def focal_of_angle(entry: Entry, size: int) -> float:
    """Return the focal length in pixels from an angle of view in radians across `size` pixels.

    Raises:
        UserError: the entry is not an angle between 0 and π.
    """
    angle = entry.number()
    if not 0 < angle < np.pi:
        raise UserError(
            f"{entry.where}: {angle:g} is not an angle of view", "give radians, above 0 and below π"
        )
    return size / (2 * np.tan(angle / 2))


def pose_from_opengl(entry: Entry) -> Float64[np.ndarray, "4 4"]:
    """Convert a rigid pose from camera to world with OpenGL axes into world to camera with OpenCV axes.

    Raises:
        UserError: the entry is not a 4×4 or 3×4 matrix of a rotation and a translation.
    """
    c2w = entry.numbers((4, 4), (3, 4))[:3]
    rotation = c2w[:, :3] * FLIP[:3]
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3:
        raise UserError(
            f"{entry.where}: not a rotation and a translation", "give camera-to-world, 4×4, row-major"
        )
    w2c = np.eye(4)
    w2c[:3, :3], w2c[:3, 3] = rotation.T, -rotation.T @ c2w[:, 3]
    return w2c


def _held_out(
    root: Path, entry: Entry, views: Sequence[View], missing: Collection[str]
) -> frozenset[str] | None:
    """The names of the test views: those of `test_filenames`, else those that `train_filenames` lacks."""
    lists = {split: entry.get(f"{split}_filenames") for split in ("train", "test")}
    given = {
        split: {stored(root, root / name.text()) for name in names.items() if name.text() not in missing}
        for split, names in lists.items()
        if names
    }
    if not given:
        return None
    for split, files in given.items():
        if not files <= {view.image for view in views}:
            raise UserError(
                f"{entry.name(f'{split}_filenames')}: names a file that no frame has", "correct the list"
            )
    train, test = given.get("train"), given.get("test")
    return frozenset(
        v.name for v in views if (v.image in test if test is not None else v.image not in (train or ()))
    )


def _given_box(entry: Entry) -> SceneBox | None:
    scene = entry.get("scene")
    return scene and SceneBox(read_scene(scene), "box")


def _points(root: Path, entry: Entry) -> Points:
    listed = entry.get("ply_file_path")
    if listed is None:
        return Points(None, None)
    path = inside(root, root / listed.text())
    if not path.is_file():
        raise UserError(f"{listed.where}: there is no {path}", "put the file there, or remove the entry")
    return Points(read_positions(path), path if has_normals(path) else None)
