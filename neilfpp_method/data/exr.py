"""OpenEXR: which part and which channels of a file are the picture, and where its pixels lie in the frame.

Renderers store many things in one file. The picture is R, G, B wherever it is in the file; else that of the
one layer that has these, or of Blender's "Combined" among several; else X, Y, Z; else a single channel. The
alpha of its layer goes with it.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import OpenEXR
from jaxtyping import Float32

from neilfpp_method.errors import UserError

__all__ = ["ExrHeader", "Window", "exr_header", "exr_samples"]

COLORS, ALPHA = ("R", "G", "B"), "A"
VECTOR = ("X", "Y", "Z")
SINGLE = (("Y",), ("Z",))
COMBINED = "Combined"
CHROMA = "RY"
"""Beside a luminance: its chroma at half the resolution."""


@dataclass(frozen=True)
class Window:
    """Where pixels lie, in OpenEXR's inclusive integer coordinates."""

    left: int
    top: int
    width: int
    height: int

    @staticmethod
    def of(box) -> Window:
        (left, top), (right, bottom) = (tuple(int(v) for v in corner) for corner in box)
        return Window(left, top, right - left + 1, bottom - top + 1)


@dataclass(frozen=True)
class ExrHeader:
    """The frame, of which the camera speaks, and what is stored of it in each of the file's parts."""

    frame: Window
    stored: tuple[Window, ...]


def exr_header(path: Path) -> ExrHeader:
    """The header of a file, no pixels.

    Raises:
        UserError: nothing in it is a picture.
    """
    parts = OpenEXR.File(str(path), header_only=True).parts
    picture = _picture(path, [[channel.name for channel in part.header["channels"]] for part in parts])
    frame = Window.of(parts[picture.part].header["displayWindow"])
    return ExrHeader(frame, tuple(Window.of(part.header["dataWindow"]) for part in parts))


def exr_samples(path: Path) -> Float32[np.ndarray, "H W C"]:
    """The picture in its frame, alpha last; 0 where the file has no pixels.

    Raises:
        UserError: nothing in the file is a picture.
        ValueError: it is damaged.
    """
    with redirect_stdout(
        io.StringIO()
    ):  # where a file is damaged, OpenEXR says so there, and goes on without the part
        parts = OpenEXR.File(str(path), separate_channels=True).parts
    if not parts:
        raise ValueError("damaged, or cut off")
    channels = [part.channels for part in parts]
    picture = _picture(path, channels)
    stored = np.stack(
        [channels[picture.part][name].pixels.astype(np.float32) for name in picture.channels], axis=-1
    )
    header = parts[picture.part].header
    data, frame = Window.of(header["dataWindow"]), Window.of(header["displayWindow"])
    if data == frame:
        return stored
    # A cropped render stores a part of its frame, an overscanned one more than it.
    samples = np.zeros((frame.height, frame.width, len(picture.channels)), np.float32)
    x, y = data.left - frame.left, data.top - frame.top
    seen = stored[max(-y, 0) : max(frame.height - y, 0), max(-x, 0) : max(frame.width - x, 0)]
    samples[max(y, 0) :, max(x, 0) :][: seen.shape[0], : seen.shape[1]] = seen
    return samples


@dataclass(frozen=True)
class Picture:
    """The number of a part, and the channels in it that are the picture, with its alpha."""

    part: int
    channels: tuple[str, ...]


def _picture(path: Path, parts: Sequence[Sequence[str] | Mapping[str, object]]) -> Picture:
    layers = {f"{prefix}.": part for part, names in enumerate(parts) for prefix in _layers(names)}
    combined = [layer for layer in layers if layer.split(".")[-2] == COMBINED]
    (layer,) = combined if len(combined) == 1 else layers if len(layers) == 1 else ("",)
    alone = [(name,) for names in parts if len(rest := set(names) - {ALPHA}) == 1 for name in rest]
    for prefix, wanted in (
        ("", COLORS),
        (layer, COLORS),
        *(("", names) for names in (VECTOR, *SINGLE, *alone)),
    ):
        channels = tuple(prefix + name for name in wanted)
        for part, names in enumerate(parts):
            if set(channels) <= set(names) and CHROMA not in names:
                return Picture(part, channels + ((prefix + ALPHA,) if prefix + ALPHA in names else ()))
    listed = ", ".join(name for names in parts for name in sorted(names))
    raise UserError(f"{path}: no RGB or single channel among {listed}", "store the image as R, G, B")


def _layers(names: Sequence[str] | Mapping[str, object]) -> list[str]:
    """The layers that have colours."""
    prefixes = sorted({name.rpartition(".")[0] for name in names} - {""})
    return [prefix for prefix in prefixes if {f"{prefix}.{color}" for color in COLORS} <= set(names)]
