"""Reader of Blender's transforms_train.json and transforms_test.json (NeRF synthetic, Stanford-ORB).

    camera_angle_x               horizontal field of view in radians, for all frames or in a frame
    frames[].file_path           the image, without suffix: .png with alpha, .exr, …; frames without one
                                   are left out
    frames[].transform_matrix    camera to world, 4×4, OpenGL axes (x right, y up, z back)
    <folder>_mask/<name>.png     optional: masks of the images in <folder>; else the alpha channel is the mask

Views of the test file are held out. Validation views and transforms_novel.json are not read.
"""

from __future__ import annotations

from pathlib import Path

from neilfpp_method.data.files.json_entry import Entry
from neilfpp_method.data.files.paths import inside
from neilfpp_method.data.formats.places import stored, view_names
from neilfpp_method.data.formats.transforms import Frame, Frames, read_frames
from neilfpp_method.data.scene_box import find_box
from neilfpp_method.data.views import CaptureFiles, View

__all__ = ["LAYOUT", "read", "recognize"]

LAYOUT = "transforms_train.json"
TEST = "transforms_test.json"


def recognize(root: Path) -> bool:
    """Whether the folder has a transforms_train.json."""
    return (root / LAYOUT).is_file()


def read(root: Path) -> CaptureFiles:
    """Read the files of the capture: the training views, then the test views.

    Raises:
        UserError: a file is malformed, most images are missing, or a path leads out of the folder.
    """
    train = read_frames(root, Entry.load(inside(root, root / LAYOUT)))
    held_out = (root / TEST).is_file()
    test = read_frames(root, Entry.load(inside(root, root / TEST))) if held_out else Frames((), ())
    frames = (*train.existing, *test.existing)
    names = view_names([frame.listed for frame in frames])
    views = tuple(
        View(name, i, frame.camera, frame.image, frame.mask or _mask(root, frame))
        for i, (name, frame) in enumerate(zip(names, frames, strict=True))
    )
    box = find_box(views)
    return CaptureFiles(
        inputs=root,
        views=views,
        normalization=box.normalization,
        test=frozenset(names[len(train.existing) :]) if held_out else None,
        scene_from=box.source,
        missing=train.missing + test.missing,
    )


def _mask(root: Path, frame: Frame) -> Path | None:
    folder = frame.image.parent
    return stored(root, folder.with_name(f"{folder.name}_mask") / f"{frame.image.stem}.png")
