"""OpenEXR files: choose the part and the channels that are the image, and place its pixels in the frame.

Renderers store many layers in one file. The image is the first of these that exists: R, G, B in the part that
is called Combined, rgba, rgb or beauty; R, G, B in any part; R, G, B of the only layer that has them, or of
the only one with such a name; X, Y, Z; a single channel. The alpha channel of the same layer belongs to it.
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
MAIN_IMAGE_NAMES = ("combined", "rgba", "rgb", "beauty")
"""Names of the part or the layer that is the image in Blender, Nuke and other renderers, in small letters;
others may stand before it, as in "ViewLayer.Combined"."""
CHROMA = "RY"
"""Chroma channel of luminance/chroma images, stored at half the resolution. They are not supported."""


@dataclass(frozen=True)
class Window:
    """A rectangle of pixels; `box` in `of` has OpenEXR's inclusive integer coordinates."""

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
    """The display window, to which the camera refers, and the data window of each part of the file."""

    frame: Window
    stored: tuple[Window, ...]


def exr_header(path: Path) -> ExrHeader:
    """Read the header of a file.

    Raises:
        UserError: no part has channels of an image.
    """
    parts = OpenEXR.File(str(path), header_only=True).parts
    listed = [[channel.name for channel in part.header["channels"]] for part in parts]
    picture = _picture(path, listed, [_part_name(part) for part in parts])
    frame = Window.of(parts[picture.part].header["displayWindow"])
    return ExrHeader(frame, tuple(Window.of(part.header["dataWindow"]) for part in parts))


def exr_samples(path: Path) -> Float32[np.ndarray, "H W C"]:
    """Read the pixels of the display window, alpha last; 0 outside of the data window.

    Raises:
        UserError: no part has channels of an image.
        ValueError: the file is damaged.
    """
    # OpenEXR reports a damaged part on standard output and continues without it.
    with redirect_stdout(io.StringIO()):
        parts = OpenEXR.File(str(path), separate_channels=True).parts
    if not parts:
        raise ValueError("damaged, or cut off")
    channels = [part.channels for part in parts]
    picture = _picture(path, channels, [_part_name(part) for part in parts])
    stored = np.stack(
        [channels[picture.part][name].pixels.astype(np.float32) for name in picture.channels], axis=-1
    )
    header = parts[picture.part].header
    data, frame = Window.of(header["dataWindow"]), Window.of(header["displayWindow"])
    if data == frame:
        return stored
    # A cropped render stores a part of its frame, a render with overscan more than its frame.
    samples = np.zeros((frame.height, frame.width, len(picture.channels)), np.float32)
    x, y = data.left - frame.left, data.top - frame.top
    visible = stored[max(-y, 0) : max(frame.height - y, 0), max(-x, 0) : max(frame.width - x, 0)]
    samples[max(y, 0) :, max(x, 0) :][: visible.shape[0], : visible.shape[1]] = visible
    return samples


@dataclass(frozen=True)
class ImageChannels:
    """The index of a part, and the names of its channels that are the image, with alpha last."""

    part: int
    channels: tuple[str, ...]


def _part_name(part: OpenEXR.Part) -> str:
    """The name of a part; empty for the part of a file that has one part only."""
    return str(part.header.get("name", ""))


def _picture(
    path: Path, parts: Sequence[Sequence[str] | Mapping[str, object]], part_names: Sequence[str]
) -> ImageChannels:
    layers = {layer for names in parts for layer in _layers(names)}
    main = [layer for layer in layers if _is_main(layer)]
    (layer,) = main if len(main) == 1 else layers if len(layers) == 1 else ("",)
    alone = [(name,) for names in parts if len(rest := set(names) - {ALPHA}) == 1 for name in rest]
    for prefix, wanted in (
        ("", COLORS),
        (f"{layer}.", COLORS),
        *(("", names) for names in (VECTOR, *SINGLE, *alone)),
    ):
        channels = tuple(prefix + name for name in wanted)
        for part in sorted(range(len(parts)), key=lambda i: not _is_main(part_names[i])):
            names = parts[part]
            if set(channels) <= set(names) and CHROMA not in names:
                return ImageChannels(part, channels + ((prefix + ALPHA,) if prefix + ALPHA in names else ()))
    listed = ", ".join(name for names in parts for name in sorted(names))
    raise UserError(f"{path}: no RGB or single channel among {listed}", "store the image as R, G, B")


def _is_main(name: str) -> bool:
    """Whether the name of a part or a layer says that it is the image and not one of its components."""
    return name.rpartition(".")[2].lower() in MAIN_IMAGE_NAMES


def _layers(names: Sequence[str] | Mapping[str, object]) -> list[str]:
    """The layers with R, G, B."""
    prefixes = sorted({name.rpartition(".")[0] for name in names} - {""})
    return [prefix for prefix in prefixes if {f"{prefix}.{color}" for color in COLORS} <= set(names)]
