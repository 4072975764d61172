"""Whether files are complete, by their formats, and the contents of a folder without times."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import trimesh
from pxr import Sdf

from neilfpp_method.data.files.images import read_image
from neilfpp_method.train.checkpoint import load_checkpoint

__all__ = ["check_whole", "comparable_files", "visible_files"]

TIMES = ("took",)
"""Entries of JSON files that differ between two commands: `took` of `relight`, in seconds."""


def visible_files(folder: Path) -> list[Path]:
    """The files under their final names. Files that are being written have hidden names."""
    return [path for path in folder.rglob("*") if path.is_file() and not path.name.startswith(".")]


def comparable_files(folder: Path) -> dict[str, bytes]:
    """The files under their final names, without times."""
    return {str(path.relative_to(folder)): _without_times(path) for path in visible_files(folder)}


def _without_times(path: Path) -> bytes:
    content = path.read_bytes()
    try:
        entries = json.loads(content) if path.suffix == ".json" else None
    except ValueError:
        return content
    if isinstance(entries, dict) and set(TIMES) & set(entries):
        return json.dumps({key: value for key, value in entries.items() if key not in TIMES}).encode()
    return content


def check_whole(path: Path) -> str | None:
    """Read a file by its format. Returns what is wrong; None if it is complete or of another format."""
    try:
        if path.suffix in _READERS:
            _READERS[path.suffix](path)
    except Exception as error:  # the readers of libraries raise any exception
        return str(error) or type(error).__name__
    return None


def _read_arrays(path: Path) -> None:
    with zipfile.ZipFile(path) as archive:
        names = archive.namelist()
    with np.load(path) as arrays:
        for name in names:
            arrays[name.removesuffix(".npy")]


def _read_page(path: Path) -> None:
    text = path.read_text("utf-8")
    if not text.rstrip().endswith("</html>"):
        raise ValueError("the page has no end")


def _read_film(path: Path) -> None:
    content, begin = path.read_bytes(), 0
    while begin < len(content):  # FFmpeg reads a film to its end whose last bytes are missing
        begin += max(int.from_bytes(content[begin : begin + 4], "big"), 8)
    if begin != len(content):
        raise ValueError(f"{len(content)} of {begin} bytes are there")
    film = cv2.VideoCapture(str(path))
    if not film.grab():
        raise ValueError("no frame can be read")


def _read_stage(path: Path) -> None:
    if Sdf.Layer.OpenAsAnonymous(str(path)) is None:
        raise ValueError("USD cannot read it")


def _read_mesh(path: Path) -> None:
    if not len(trimesh.load(path, force="mesh").faces):
        raise ValueError("it has no faces")


_READERS: Mapping[str, Callable[[Path], object]] = {
    ".pt": load_checkpoint,
    ".json": lambda path: json.loads(path.read_text()),
    ".png": read_image,
    # Several layers: a capture cannot contain such an image. `File` alone only warns if pixels are missing.
    ".exr": lambda path: OpenEXR.File(str(path)).channels(),
    ".ply": trimesh.load,  # also clouds of points
    ".glb": _read_mesh,
    ".npz": _read_arrays,
    ".npy": lambda path: np.load(path, allow_pickle=False),
    ".html": _read_page,
    ".usda": _read_stage,
    ".mp4": _read_film,
}
"""Functions that read a file of each format to its end, and raise an exception if it is not complete."""
