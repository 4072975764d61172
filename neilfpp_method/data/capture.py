"""A capture: posed images of a scene, read from one of several layouts, checked, normalised and split.

Everything that the headers contain is checked here, before a run starts; pixels are checked when they are
loaded.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol

import numpy as np

from neilfpp_method.data import capture_folder
from neilfpp_method.data.cameras.camera import Camera, check_camera
from neilfpp_method.data.files.image_parts import ImageHeader
from neilfpp_method.data.files.images import IMAGE_SUFFIXES, image_header
from neilfpp_method.data.files.paths import plain_name
from neilfpp_method.data.files.raw import RAW_SUFFIXES
from neilfpp_method.data.formats import blender, colmap, dtu, nerfactor, nero, sfm_scene, transforms
from neilfpp_method.data.split import held_out_views
from neilfpp_method.data.views import CaptureFiles, Normalization, SceneSource, View
from neilfpp_method.errors import UserError

__all__ = [
    "BOX_SOURCES",
    "READERS",
    "Camera",
    "Capture",
    "Normalization",
    "Reader",
    "View",
    "load_capture",
    "refuse_run",
]


@dataclass(frozen=True)
class UnusableCameras:
    """A pattern of files with cameras that cannot be used, the reason, and the remedy."""

    pattern: str
    reason: str
    remedy: str


UNUSABLE = (
    UnusableCameras(
        "transforms_*.json",
        "no transforms_train.json",
        "add the file of the training views, or name a file that lists all views transforms.json",
    ),
    UnusableCameras(
        "test_[0-9]*/metadata.json",
        "no train_000/metadata.json",
        "add the folders of the training views",
    ),
    UnusableCameras(
        "cams/*_cam.txt",
        "cameras of MVSNet and BlendedMVS are not read",
        "write them as transforms.json, or run neilfpp prepare on the folder of the images",
    ),
)

MAX_CAMERA_DISTANCE = 1e6
"""Largest distance of a camera from the scene box, in scene units; float32 has a step of 0.06 there."""
BOX_SOURCES: Mapping[SceneSource, str] = {
    "box": ", as stated by the capture",
    "points": ", computed from the points",
    "focus": ", from the point that the cameras look at, because the points extend far beyond it",
    "masks": ", computed from the masks",
    "cameras": ", guessed from the cameras only: add masks, points or a scene box if it is wrong",
}
"""Source of the scene box, as the end of a line about the box."""


class Reader(Protocol):
    """A module that reads one layout; `LAYOUT` describes the layout in a few words."""

    LAYOUT: str

    def recognize(self, root: Path) -> bool:
        """Return whether the folder has this layout, without reading large files."""

    def read(self, root: Path) -> CaptureFiles:
        """Read the files of the capture; raises a `UserError` if they contradict the layout."""


READERS: Mapping[str, Reader] = {
    "neilfpp": capture_folder,
    "sfm_scene": sfm_scene,
    "dtu": dtu,
    "transforms": transforms,
    "blender": blender,
    "nerfactor": nerfactor,
    "colmap": colmap,
    "nero": nero,
}
"""The readers by the name of the layout; the first that recognises a folder reads it."""


@dataclass(frozen=True)
class Capture:
    """A checked capture.

    Attributes:
        root: folder of the capture.
        format: name of its layout in `READERS`.
        inputs: folder of masks, depth maps and other companions of the images.
        views: all views, with cameras in the world frame.
        normalization: the transformation from the world frame to the scene frame.
        hdr: whether pixels are linear radiance; otherwise they are display values (sRGB).
        test: names of the test views.
        point_cloud: oriented point cloud; None if there is none.
        scene_from: where the normalisation comes from.
        missing: images that the capture lists and that do not exist; they have no view.
    """

    root: Path
    format: str
    inputs: Path
    views: tuple[View, ...]
    normalization: Normalization
    hdr: bool
    test: frozenset[str]
    point_cloud: Path | None = None
    scene_from: SceneSource = "box"
    missing: tuple[str, ...] = ()

    @property
    def train_views(self) -> tuple[View, ...]:
        """The training views, in order."""
        return tuple(view for view in self.views if view.name not in self.test)

    @property
    def test_views(self) -> tuple[View, ...]:
        """The test views, in order."""
        return tuple(view for view in self.views if view.name in self.test)

    def chosen_views(self, words: Sequence[str]) -> tuple[View, ...]:
        """The views with these names, in order; "test", "train" and "all" stand for groups of views.

        Raises:
            UserError: a word is neither a group nor the name of a view, or a group is empty.
        """
        groups = {"test": self.test_views, "train": self.train_views, "all": self.views}
        names = {view.name: (view,) for view in self.views}
        for word in words:
            if word in groups and not groups[word]:
                raise UserError(f"{self.root}: there is no {word} view", "give --views all")
            if word not in groups and word not in names:
                remedy = f"give test, train, all, or names of views, such as {self.views[0].name}"
                raise UserError(f"{self.root}: there is no view '{word}'", remedy)
        chosen = {view.name for word in words for view in (groups.get(word) or names[word])}
        return tuple(view for view in self.views if view.name in chosen)

    def scene_camera(self, view: View) -> Camera:
        """The camera of a view in the scene frame."""
        return self.normalization.camera(view.camera)

    @property
    def summary(self) -> str:
        """The capture in three lines for the console, and one more if listed images are missing."""
        sizes = sorted({(view.camera.width, view.camera.height) for view in self.views})
        size = f"{sizes[0][0]}×{sizes[0][1]}" if len(sizes) == 1 else f"{len(sizes)} sizes"
        masks = sum(view.mask is not None for view in self.views)
        x, y, z = self.normalization.center
        return "\n".join(
            [
                f"{self.root.resolve().name} ({self.format}): {len(self.views)} views of {size}, "
                f"{len(self.train_views)} to train on and {len(self.test_views)} to test on",
                f"pixels: {'linear HDR' if self.hdr else 'display values (sRGB)'}; "
                f"mask files: {_masks_text(masks, len(self.views))}; "
                f"point cloud: {self.point_cloud.name if self.point_cloud else 'none'}",
                f"scene: centre ({x:.3g}, {y:.3g}, {z:.3g}), 1 scene unit = {self.normalization.scale:.4g} "
                "world units" + BOX_SOURCES[self.scene_from],
                *(f"warning: {remark}" for remark in self.remarks),
            ]
        )

    @property
    def remarks(self) -> tuple[str, ...]:
        """What a user should know about the files of the capture: listed images that are missing."""
        if not self.missing:
            return ()
        listed = len(self.views) + len(self.missing)
        count = f"{len(self.missing)} of {listed} listed images are missing and left out"
        return (f"{count}; the first is {self.missing[0]}",)


def load_capture(
    root: Path | str,
    format: str | None = None,
    test_every: int | None = None,
    test: Collection[str | int] | None = None,
    response: Literal["auto", "linear", "srgb"] = "auto",
) -> Capture:
    """Find, read and check a capture.

    Args:
        root: the capture's folder.
        format: a name in `READERS`; if None, the first reader that recognises the folder.
        test_every: hold out every k-th view, from the k-th on; 0 holds out no view. Overrides `split.json`.
        test: hold out these views, by name or by number; overrides `test_every` and `split.json`. Without any
            of the three, the split of the capture is used, and if it has none, every 8th view is held out.
        response: whether pixels are linear radiance or display values; "auto": as the capture states, and if
            it does not, floating-point files are linear.

    Raises:
        UserError: the capture cannot be used; the message names the file and the remedy.
    """
    root = Path(root)
    if not root.is_dir():
        problem = "a file, not a folder" if root.exists() else "no such folder"
        raise UserError(f"{root}: {problem}", "give the folder of a capture")
    format = format or _recognize(root)
    if format not in READERS:
        raise UserError(f"unknown capture format '{format}'", f"choose one of {', '.join(READERS)}")
    if not READERS[format].recognize(root):
        raise UserError(f"{root}: not a capture of the format {format}", f"it needs {READERS[format].LAYOUT}")
    files = READERS[format].read(root)
    floating = _check_views(files.views)
    _check_box(root, files)
    hdr = floating if files.hdr is None else files.hdr
    return Capture(
        root=root,
        format=format,
        inputs=files.inputs,
        views=files.views,
        normalization=files.normalization,
        hdr={"auto": hdr, "linear": True, "srgb": False}[response],
        test=held_out_views(root, files, test_every, test),
        point_cloud=files.point_cloud,
        scene_from=files.scene_from,
        missing=files.missing,
    )


def _masks_text(masks: int, views: int) -> str:
    """The number of mask files, with that of the views if some have none."""
    return f"{masks} of {views}" if 0 < masks < views else str(masks or "none")


def _recognize(root: Path) -> str:
    for name, reader in READERS.items():
        if reader.recognize(root):
            return name
    refuse_run(root)
    _check_cameras(root)
    photographs = _photographs(root)
    if photographs:
        remedy = f"run neilfpp prepare {root} --out CAPTURE, and train on CAPTURE"
        raise UserError(f"{root}: {photographs} photographs and no cameras", remedy)
    layouts = "; ".join(f"{name} ({reader.LAYOUT})" for name, reader in READERS.items())
    raise UserError(f"{root}: no capture in this folder", f"the formats are: {layouts}")


def refuse_run(root: Path) -> None:
    """Raise a `UserError` if the folder is that of a run, whose pictures are not photographs of a scene."""
    if (root / "config.json").is_file() and (root / "capture.json").is_file():
        raise UserError(f"{root}: a run folder, not a capture", "give the folder that the run was trained on")


def _check_cameras(root: Path) -> None:
    """Raise a `UserError` if there are cameras that cannot be used, or if a sub-folder is a capture."""
    for cameras in UNUSABLE:
        found = min(root.glob(cameras.pattern), default=None)
        if found is not None:
            raise UserError(
                f"{root}: there is {found.relative_to(root)}, but {cameras.reason}", cameras.remedy
            )
    for folder in sorted(path for path in root.iterdir() if path.is_dir()):
        # A folder that must not be read is none of the user's captures.
        with suppress(OSError):
            if any(reader.recognize(folder) for reader in READERS.values()):
                raise UserError(f"{root}: the capture is in the sub-folder {folder.name}", f"give {folder}")


def _photographs(root: Path) -> int:
    """Number of photographs in a folder and its direct sub-folders."""
    files = [*root.glob("*"), *root.glob("*/*")]
    return sum(
        file.suffix.lower() in (*IMAGE_SUFFIXES, *RAW_SUFFIXES)
        for file in files
        if not file.name.startswith(".")
    )


def _check_views(views: Sequence[View]) -> bool:
    """Check all views; return whether their images are HDR, which either all or none must be."""
    by_name: dict[str, View] = {}
    by_kind: dict[bool, View] = {}
    for view in views:
        _check_view(view)
        if view.name in by_name:
            other = by_name[view.name].image
            if view.image == other:
                raise UserError(f"{other}: listed twice", "list it once")
            raise UserError(f"{view.image} and {other} have the same name", "rename one of them")
        by_name[view.name] = view
        by_kind.setdefault(_checked_header(view).hdr, view)
    if len(by_kind) > 1:
        raise UserError(
            f"{by_kind[True].image} is HDR and {by_kind[False].image} is LDR", "use images of one kind"
        )
    return next(iter(by_kind))


def _check_box(root: Path, files: CaptureFiles) -> None:
    """Check that the cameras are near the scene box, so that rays can be computed in float32."""
    with np.errstate(over="ignore", invalid="ignore"):
        shifts = np.stack([files.normalization.camera(view.camera).w2c[:3, 3] for view in files.views])
        distance = np.linalg.norm(shifts, axis=1).max()
    if not distance <= MAX_CAMERA_DISTANCE:
        raise UserError(
            f"{root}: a camera is {distance:.3g} times the radius of the scene box away from it",
            "correct the centre and the radius of the scene box",
        )


def _check_view(view: View) -> None:
    """Check the camera, the name and the factors of a view."""
    check_camera(view.camera, str(view.image))
    if not plain_name(view.name):
        raise UserError(f"{view.image}: '{view.name}' is not a valid file name", "rename the view")
    if not all(np.isfinite(f) and f > 0 for f in (view.exposure, *view.white_balance)):
        raise UserError(
            f"{view.image}: exposure and white balance are not all positive", "correct the factors"
        )


def _checked_header(view: View) -> ImageHeader:
    """The header of the image of a view; image and masks must have the size of the camera."""
    size = (view.camera.width, view.camera.height)
    headers = {path: image_header(path) for path in (view.image, view.mask, view.valid) if path}
    for path, header in headers.items():
        if (header.width, header.height) != size:
            remedy = "resize the image, or scale its camera"
            if path != view.image:
                remedy = "make the mask again, with the size and orientation of the stored image"
            elif (header.height, header.width) == size:
                remedy = "rotate the pixels as the EXIF data of the image states"
            raise UserError(
                f"{path}: {header.width}×{header.height} pixels where the camera has {size[0]}×{size[1]}",
                remedy,
            )
    return headers[view.image]
