"""Read and write the capture layout of this project: `capture.json`, and the files that it names.

docs/captures.md describes every entry, so other programs can read and write such folders.
"""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any, Literal, Protocol, get_args, runtime_checkable

import numpy as np

from neilfpp_method.data.cameras.camera import Camera
from neilfpp_method.data.cameras.lens import Lens
from neilfpp_method.data.files.json_entry import Entry, write_json
from neilfpp_method.data.files.paths import inside
from neilfpp_method.data.views import CaptureFiles, Normalization, SceneSource, View
from neilfpp_method.errors import UserError

__all__ = ["FILE", "LAYOUT", "Writable", "read", "read_scene", "recognize", "write_capture"]

LAYOUT = "a capture.json that names its format"
FILE = "capture.json"
FORMAT = "neilfpp-capture"
VERSION = 1


def recognize(root: Path) -> bool:
    """Return whether the folder has a `capture.json` of this format; that of a run folder is another file."""
    path = root / FILE
    return path.is_file() and FORMAT.encode() in path.read_bytes()


def read(root: Path) -> CaptureFiles:
    """Read a capture.

    Raises:
        UserError: `capture.json` is malformed or of a later version, or names a file that is missing or
            outside of the folder.
    """
    entry = Entry.load(inside(root, root / FILE))
    entry["format"].word(FORMAT)
    if entry["version"].size() > VERSION:
        raise UserError(
            f"{entry.where}: version {entry['version'].size()} of the format",
            f"this version of the package reads version {VERSION}",
        )
    views = tuple(_view(root, i, view) for i, view in enumerate(entry["views"].items()))
    if not views:
        raise UserError(f"{entry.where}: no views", "add views to the list")
    test = entry.get("test")
    return CaptureFiles(
        inputs=root,
        views=views,
        normalization=read_scene(entry["scene"]),
        point_cloud=_file(root, entry, "point_cloud"),
        test=None if test is None else frozenset(name.word() for name in test.items()),
        hdr=entry["response"].word("linear", "srgb") == "linear",
        scene_from=_source(entry["scene"]),
    )


def read_scene(entry: Entry) -> Normalization:
    """Read the scene box from an entry with `centre` and `radius`, in world units.

    Raises:
        UserError: one of them is missing or not a number, or the radius is not positive.
    """
    x, y, z = map(float, entry["centre"].numbers((3,)))
    radius = entry["radius"].number()
    if radius <= 0:
        raise UserError(
            f"{entry.name('radius')}: not positive", "give half of the longest edge of the scene box"
        )
    return Normalization(radius, (x, y, z))


def _source(scene: Entry) -> SceneSource:
    """The source of the scene box, as recorded when the folder was written."""
    source = scene.get("source")
    return "box" if source is None else source.word(*get_args(SceneSource))


def _view(root: Path, index: int, entry: Entry) -> View:
    image = _file(root, entry, "image")
    if image is None:
        raise UserError(f"{entry.name('image')} is missing", "give the path of the image file")
    exposure, balance = entry.get("exposure"), entry.get("white_balance")
    red, green, blue = (1.0, 1.0, 1.0) if balance is None else map(float, balance.numbers((3,)))
    return View(
        name=entry["name"].word(),
        index=index,
        camera=_camera(entry["camera"]),
        image=image,
        mask=_file(root, entry, "mask"),
        valid=_file(root, entry, "valid"),
        exposure=1.0 if exposure is None else exposure.number(),
        white_balance=(red, green, blue),
    )


def _camera(entry: Entry) -> Camera:
    fx, fy, cx, cy = (entry[name].number() for name in ("fx", "fy", "cx", "cy"))
    lens = entry.get("lens")
    return Camera(
        fx=fx,
        fy=fy,
        cx=cx,
        cy=cy,
        width=entry["width"].size(),
        height=entry["height"].size(),
        w2c=entry["w2c"].numbers((4, 4), (16,)).reshape(4, 4),
        lens=lens and Lens(lens["model"].word(), tuple(map(float, lens["coefficients"].numbers()))),
    )


def _file(root: Path, entry: Entry, key: str) -> Path | None:
    named = entry.get(key)
    if named is None:
        return None
    path = inside(root, root / named.text())
    if not path.is_file():
        raise UserError(f"{named.where}: there is no {path}", "put the file there, or correct the path")
    return path


# ---------------------------------------------------------------------------------------------------- writing


@runtime_checkable
class Writable(Protocol):
    """What `write_capture` writes: a `CaptureFiles` or a `Capture`."""

    @property
    def views(self) -> tuple[View, ...]: ...

    @property
    def normalization(self) -> Normalization: ...

    @property
    def point_cloud(self) -> Path | None: ...

    @property
    def scene_from(self) -> SceneSource: ...


def write_capture(
    root: Path, files: Writable, *, response: Literal["linear", "srgb"], test: Collection[str] = ()
) -> Path:
    """Write `capture.json` into a folder that already contains images, masks and points; return its path.

    Args:
        root: the folder of the capture.
        files: views, scene box and point cloud; all paths are inside of `root`.
        response: meaning of the pixel values.
        test: names of the held-out views.

    Raises:
        UserError: a path leads out of `root`, or `test` contains a name that no view has.
    """
    names = [view.name for view in files.views]
    if strange := sorted(set(test) - set(names)):
        raise UserError(f"{root}: there is no view {strange[0]!r} to hold out", "choose views of the capture")
    description = {
        "format": FORMAT,
        "version": VERSION,
        "response": response,
        "scene": {
            "centre": list(files.normalization.center),
            "radius": files.normalization.scale,
            "source": files.scene_from,
        },
        "test": [name for name in names if name in test],
        "point_cloud": _relative(root, files.point_cloud),
        "views": [_described(root, view) for view in files.views],
    }
    write_json(root / FILE, description)
    return root / FILE


def _described(root: Path, view: View) -> dict[str, Any]:
    camera, lens = view.camera, view.camera.lens
    numbers = {name: float(getattr(camera, name)) for name in ("fx", "fy", "cx", "cy")}
    return {
        "name": view.name,
        "image": _relative(root, view.image),
        "mask": _relative(root, view.mask),
        "valid": _relative(root, view.valid),
        "camera": {
            **numbers,
            "width": camera.width,
            "height": camera.height,
            "w2c": np.asarray(camera.w2c, np.float64).tolist(),
            "lens": lens and {"model": lens.model, "coefficients": list(map(float, lens.coefficients))},
        },
        "exposure": float(view.exposure),
        "white_balance": list(map(float, view.white_balance)),
    }


def _relative(root: Path, path: Path | None) -> str | None:
    """The path as it is written into the file: relative to `root`, with forward slashes."""
    return path and inside(root, path).resolve().relative_to(root.resolve()).as_posix()
