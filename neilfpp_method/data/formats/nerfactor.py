"""Reader of the synthetic scenes of NeRFactor and TensoIR: a folder for each view.

    train_<i>/, test_<i>/    one view each, <i> of three digits
      metadata.json            cam_angle_x: horizontal field of view in radians
                               cam_transform_mat: camera to world, 4×4, OpenGL axes (x right, y up, z back),
                                 as text of 16 numbers with commas
      rgba.png                 the image, whose alpha channel is the mask

The test views are held out; those without an image are left out. Not read are val_<i>/ and images under other
lights, such as TensoIR's rgba_sunset.png.
"""

from __future__ import annotations

from pathlib import Path

from neilfpp_method.data.cameras.camera import Camera
from neilfpp_method.data.files.images import image_header
from neilfpp_method.data.files.json_entry import Entry
from neilfpp_method.data.files.paths import inside
from neilfpp_method.data.formats.places import stored
from neilfpp_method.data.formats.transforms import focal_of_angle, pose_from_opengl
from neilfpp_method.data.scene_box import find_box
from neilfpp_method.data.views import CaptureFiles, View
from neilfpp_method.errors import UserError

__all__ = ["LAYOUT", "read", "recognize"]

LAYOUT = "train_000/metadata.json and train_000/rgba.png"
FILE = "metadata.json"
IMAGE = "rgba.png"


def recognize(root: Path) -> bool:
    """Whether the folder has a training view."""
    return any(root.glob(f"train_[0-9]*/{FILE}"))


def read(root: Path) -> CaptureFiles:
    """Read the files of the capture: the training views, then the test views, each by its number.

    Raises:
        UserError: a metadata.json is missing or malformed, or an image is missing or outside of the folder.
    """
    train, test = (sorted(root.glob(f"{split}_[0-9]*")) for split in ("train", "test"))
    folders = [*train, *(folder for folder in test if stored(root, folder / IMAGE))]
    views = tuple(_view(root, i, folder) for i, folder in enumerate(folders))
    held_out = frozenset(view.name for view in views[len(train) :])
    box = find_box(views)
    return CaptureFiles(root, views, box.normalization, test=held_out or None, scene_from=box.source)


def _view(root: Path, index: int, folder: Path) -> View:
    entry = Entry.load(inside(root, folder / FILE))
    image = stored(root, folder / IMAGE)
    if image is None:
        raise UserError(
            f"{folder}: there is no {IMAGE}",
            f"put the image there; of images under several lights, copy those of one light to {IMAGE}",
        )
    header = image_header(image)
    focal = focal_of_angle(entry["cam_angle_x"], header.width)
    pose = entry["cam_transform_mat"]
    numbers = Entry(pose.word().split(","), pose.where).numbers((16,))
    camera = Camera(
        fx=focal,
        fy=focal,
        cx=header.width / 2,
        cy=header.height / 2,
        width=header.width,
        height=header.height,
        w2c=pose_from_opengl(Entry(numbers.reshape(4, 4), pose.where)),
    )
    return View(folder.name, index, camera, image)
