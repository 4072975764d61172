"""Store the pixels of many views, in memory or in memory-mapped files: view after view, row by row.

    color.npy    (P, 3) codes of `data.pixels.encoding`: 3 bytes per pixel for 8-bit images, else 6 or 12
    bits.npy     (P,) one byte: valid, mask, mask known, near the object (`drawing`); padded to whole blocks
    store.json   the inputs of the store; it is written last, so a folder without it is incomplete

Views are read one at a time, so building a store takes the memory of one view. A store is used again if it
was built from the same files (name, size, modification time), cameras and factors; otherwise it is built
again.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import mmap
import os
import shutil
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int, Shaped, UInt8

from neilfpp_method.data.files.atomic_file import replacing
from neilfpp_method.data.pixels.drawing import BLOCK, KNOWN, MASK, NEAR, VALID, near_object
from neilfpp_method.data.pixels.encoding import BYTES, ENCODINGS, Encoding, encodings_for
from neilfpp_method.data.pixels.view_pixels import read_view
from neilfpp_method.data.scaling import file_size
from neilfpp_method.data.views import View
from neilfpp_method.errors import UserError

__all__ = ["PixelStore", "advise_random_access", "border", "load_pixels", "store_bytes"]

FORMAT, VERSION = "neilfpp-pixels", 1
BORDER_SHARE = 0.5
"""Smallest share of border pixels of one colour with which that colour is the background."""
REPAIR = "repair the images, or mark the pixels in a validity mask"
MAX_MAPPED = 2**29
"""Largest number of bytes that draws may leave mapped; reading one pixel maps 16 pages."""
BYTES_OF_A_DRAW = 2 * 16 * 4096
"""Number of bytes that reading one pixel maps: 16 pages of 4096 bytes in each of two files."""
MIN_FREE_BYTES = 2**28
"""Number of bytes that should remain free on the disk."""


@dataclass
class PixelStore:
    """The P pixels of some views, indexed view after view, row by row.

    Attributes:
        views: the views, in order.
        encoding: encoding of `codes`.
        scales: factor of the codes of each view.
        codes: colour codes, (P, 3).
        bits: bits of each pixel (`drawing`), padded with zeros to a whole number of blocks.
    """

    views: tuple[View, ...]
    encoding: Encoding
    scales: Float64[np.ndarray, " V"]
    codes: Shaped[np.ndarray, "P 3"]
    bits: UInt8[np.ndarray, " B"]

    def __post_init__(self) -> None:
        sizes = [view.camera.width * view.camera.height for view in self.views]
        self.starts = np.array(list(itertools.accumulate(sizes, initial=0)))
        self._drawn = 0

    def __len__(self) -> int:
        return int(self.starts[-1])

    def indices(self, i: int) -> slice:
        """Return the indices of the pixels of view `i`."""
        return slice(int(self.starts[i]), int(self.starts[i + 1]))

    def colors(
        self, numbers: Int[np.ndarray, "*N"], view: Int[np.ndarray, "*N"]
    ) -> Float32[np.ndarray, "*N 3"]:
        """Return colours of single pixels; of a store on disk, only the pages that contain them are read."""
        self._drawn += numbers.size
        if self._drawn * BYTES_OF_A_DRAW > MAX_MAPPED:
            self.release()
        return self.encoding.decode(self.codes[numbers], self.scales[view])

    def view_colors(self, i: int) -> Float32[np.ndarray, "N 3"]:
        """Return the colours of a view."""
        return self.encoding.decode(np.asarray(self.codes[self.indices(i)]), self.scales[i])

    def views_of(self, numbers: Int[np.ndarray, "*N"]) -> Int[np.ndarray, "*N"]:
        """Return the index of the view of each pixel."""
        return np.searchsorted(self.starts, numbers, side="right") - 1

    def release(self) -> None:
        """Unmap the pages of the files; later reads map them again."""
        self._drawn = 0
        for array in (self.codes, self.bits):
            _advise(array, "MADV_DONTNEED")


def store_bytes(views: Sequence[View], hdr: bool) -> int:
    """Estimate the number of bytes of a store of the given views."""
    pixels = sum(view.camera.width * view.camera.height for view in views)
    narrow = not hdr and all(view.file_size is None for view in views)
    return pixels * (4 if narrow else 7)


def load_pixels(
    views: Sequence[View],
    hdr: bool,
    has_ray: Callable[[int], Bool[np.ndarray, " N"]],
    folder: Path | None = None,
    on_view: Callable[[str], None] | None = None,
    exact: bool = False,
) -> PixelStore:
    """Load the pixels of views: from a store with the same inputs if there is one, else from the images.

    Args:
        views: the views, at least one.
        hdr: whether pixels are linear radiance rather than display values.
        has_ray: function that returns which pixels of a view have a ray through its lens.
        folder: folder of the store; None: in memory.
        on_view: called with the name of each view that has been read.
        exact: store the values of the files in single precision, with 13 bytes per pixel; only in memory.

    Raises:
        UserError: an image cannot be used (see `PixelDataset`), or the folder cannot be written.
    """
    if exact and folder is not None:
        raise ValueError("exact pixels can only be stored in memory")
    images = _Images(tuple(views), hdr, has_ray)
    if folder is None:
        return _fill_smallest(images, encodings_for(hdr, exact), None, on_view)
    made_from = _made_from(views, hdr)
    reusable = _open(folder, views, made_from)
    if reusable is not None:
        return reusable
    _check_room(folder, store_bytes(views, hdr))
    (folder / "store.json").unlink(missing_ok=True)
    with ExitStack() as files:
        paths = {name: files.enter_context(replacing(folder / f"{name}.npy")) for name in ("color", "bits")}
        store = _fill_smallest(images, encodings_for(hdr), paths, on_view)
        description = {
            "format": FORMAT,
            "version": VERSION,
            "made_from": made_from,
            "encoding": store.encoding.name,
            "scales": store.scales.tolist(),
        }
        store.release()
    with replacing(folder / "store.json") as temporary:
        temporary.write_text(json.dumps(description) + "\n", "utf-8")
    opened = _open(folder, views, made_from)
    if opened is None:
        raise UserError(f"{folder}: changed while it was written", "let one training at a time write there")
    return opened


# ----------------------------------------------------------------------------------------------------- making


@dataclass(frozen=True)
class _Images:
    """What a store is filled from; the attributes are the arguments of `load_pixels`."""

    views: tuple[View, ...]
    hdr: bool
    has_ray: Callable[[int], Bool[np.ndarray, " N"]]


def _fill_smallest(
    images: _Images,
    ladder: Sequence[Encoding],
    paths: dict[str, Path] | None,
    on_view: Callable[[str], None] | None,
) -> PixelStore:
    """Fill a store with the smallest encoding that can represent all views.

    The encodings are tried from small to large; all views are read again for each.
    """
    if ladder[0] is BYTES and any(view.file_size is not None for view in images.views):
        # Averages of 8-bit values are not 8-bit values.
        ladder = ladder[1:]
    reported: set[str] = set()

    def report_once(name: str) -> None:
        if on_view and name not in reported:
            reported.add(name)
            on_view(name)

    stores = (_fill(images, encoding, paths, report_once) for encoding in ladder)
    return next(store for store in stores if store is not None)


def _fill(
    images: _Images, encoding: Encoding, paths: dict[str, Path] | None, on_view: Callable[[str], None]
) -> PixelStore | None:
    """Fill a store with the given encoding; return None if the encoding cannot represent a view."""
    views = images.views
    total = sum(view.camera.width * view.camera.height for view in views)
    codes = _plane(paths and paths["color"], (total, 3), encoding.dtype)
    bits = _plane(paths and paths["bits"], (-(-total // BLOCK) * BLOCK,), np.dtype(np.uint8))
    store = PixelStore(views, encoding, np.ones(len(views)), codes, bits)
    broken: list[tuple[View, int]] = []
    unknown = []
    for i, view in enumerate(views):
        pixels = read_view(view, images.hdr)
        if pixels.broken:
            broken.append((view, pixels.broken))
        elif not broken:
            encoded = encoding.encode(pixels.color)
            if encoded is None:
                return None
            codes[store.indices(i)], store.scales[i] = encoded.codes.reshape(-1, 3), encoded.scale
            bits[store.indices(i)] = _bits(pixels.mask, pixels.valid.reshape(-1) & images.has_ray(i))
            if pixels.mask is None:
                unknown.append(i)
            store.release()
        on_view(view.name)
    if broken:
        view, count = broken[0]
        others = f", and {len(broken) - 1} more images have such pixels" if len(broken) > 1 else ""
        raise UserError(f"{view.image}: {count} pixels are NaN, infinite or negative{others}", REPAIR)
    if len(unknown) == len(views):
        _mask_from_background(store)
    else:
        # In views without a mask every pixel may be on the object, so all count as near it.
        for i in unknown:
            bits[store.indices(i)] |= NEAR
    return store


def _bits(mask: Bool[np.ndarray, "H W"] | None, valid: Bool[np.ndarray, " N"]) -> UInt8[np.ndarray, " N"]:
    bits = np.where(valid, VALID, 0).astype(np.uint8)
    if mask is None:
        return bits | np.uint8(MASK)
    return bits | np.uint8(KNOWN) | np.where(mask.reshape(-1), MASK, 0).astype(np.uint8) | _near(mask)


def _near(mask: Bool[np.ndarray, "H W"]) -> UInt8[np.ndarray, " N"]:
    return np.where(near_object(mask).reshape(-1), NEAR, 0).astype(np.uint8)


def _mask_from_background(store: PixelStore) -> None:
    """Mark the pixels as background whose colour is exactly that of most border pixels.

    For all other pixels the mask remains unknown. Rendered captures and clipped backdrops have such pixels;
    photographs of other backdrops have few because of noise.
    """
    numbers = border(store)
    colors = store.colors(numbers, store.views_of(numbers))
    if not len(colors):
        return
    color = _median(colors)
    if (colors == color).all(axis=-1).mean() < BORDER_SHARE:
        return
    if all((store.view_colors(i) == color).all() for i in range(len(store.views))):
        return
    for i, view in enumerate(store.views):
        background = (store.view_colors(i) == color).all(axis=-1)
        bits = store.bits[store.indices(i)] & np.uint8(VALID)
        bits |= np.where(background, KNOWN, MASK).astype(np.uint8)
        shape = (view.camera.height, view.camera.width)
        store.bits[store.indices(i)] = bits | _near(~background.reshape(shape))
        store.release()


def _median(values: Float32[np.ndarray, "N C"]) -> Float32[np.ndarray, " C"]:
    """The lower median per channel: one of the values, so the colour of most pixels is found exactly."""
    return np.partition(values, (len(values) - 1) // 2, axis=0)[(len(values) - 1) // 2]


def border(store: PixelStore) -> Int[np.ndarray, " B"]:
    """Return the indices of the valid pixels on the borders of all images.

    Pixels that a mask assigns to the object are left out: an object that extends beyond the image is not a
    part of the background.
    """
    numbers = []
    for i, view in enumerate(store.views):
        width, height = view.camera.width, view.camera.height
        row, left = np.arange(width), np.arange(1, height - 1) * width
        edge = store.starts[i] + np.concatenate([row, (height - 1) * width + row, left, left + width - 1])
        bits, on_object = store.bits[edge], KNOWN | MASK
        numbers.append(edge[((bits & VALID) > 0) & ((bits & on_object) != on_object)])
    return np.concatenate(numbers)


# -------------------------------------------------------------------------------------------------- the files


def _plane(path: Path | None, shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
    """Make an array of zeros in memory, or in a file.

    The blocks of the file are allocated at once, because writing to a memory map on a full disk would end the
    process.
    """
    if path is None:
        return np.zeros(shape, dtype)
    array = np.lib.format.open_memmap(path, mode="w+", dtype=dtype, shape=shape)
    if hasattr(os, "posix_fallocate"):
        with path.open("r+b") as file:
            os.posix_fallocate(file.fileno(), 0, path.stat().st_size)
    return array


def _check_room(folder: Path, needed: int) -> None:
    above = next(place for place in (folder, *folder.absolute().parents) if place.exists())
    free = shutil.disk_usage(above).free
    if needed + MIN_FREE_BYTES > free:
        raise UserError(
            f"{folder}: the pixels of the training views take {needed / 1e9:.1f} GB, and {free / 1e9:.1f} GB "
            "are free there",
            "free disk space, choose another --out, or reduce the images with --scale",
        )


def _made_from(views: Sequence[View], hdr: bool) -> str:
    """Return a hash of everything that the content of a store depends on."""
    parts: list[object] = [VERSION, hdr]
    for view in views:
        camera = view.camera
        lens = camera.lens and (camera.lens.model, camera.lens.coefficients)
        parts.append([view.name, camera.width, camera.height, camera.intrinsics.tolist(), lens])
        parts.append([view.exposure, view.white_balance, list(file_size(view))])
        parts += [_state(path) for path in (view.image, view.mask, view.valid)]
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()


def _state(path: Path | None) -> tuple[str, int, int] | None:
    if path is None or not path.is_file():
        return None
    status = path.stat()
    return path.name, status.st_size, status.st_mtime_ns


def _open(folder: Path, views: Sequence[View], made_from: str) -> PixelStore | None:
    """Open the store of a folder; None if it does not exist, is damaged, or has other inputs."""
    try:
        description = json.loads((folder / "store.json").read_text("utf-8"))
        kind = [description[name] for name in ("format", "version", "made_from")]
        encoding, scales = ENCODINGS[description["encoding"]], np.array(description["scales"], np.float64)
        arrays = [
            np.load(folder / f"{name}.npy", mmap_mode="r", allow_pickle=False) for name in ("color", "bits")
        ]
    except Exception:
        # A forged header of an array can raise any exception: NumPy evaluates it as Python source.
        return None
    store = PixelStore(tuple(views), encoding, scales, *arrays)
    shapes = [(len(store), 3), (-(-len(store) // BLOCK) * BLOCK,)]
    types = [encoding.dtype, np.dtype(np.uint8)]
    scales_fit = scales.shape == (len(views),) and bool((np.isfinite(scales) & (scales > 0)).all())
    fits = scales_fit and kind == [FORMAT, VERSION, made_from]
    if not fits or [a.shape for a in arrays] != shapes or [a.dtype for a in arrays] != types:
        return None
    return store


def advise_random_access(store: PixelStore) -> None:
    """Tell the operating system that single pixels will be read, so that it does not read pages ahead."""
    for array in (store.codes, store.bits):
        _advise(array, "MADV_RANDOM")


def _advise(array: np.ndarray, what: str) -> None:
    mapped = getattr(array, "_mmap", None)
    if mapped is not None and hasattr(mmap, what):
        mapped.madvise(getattr(mmap, what))
