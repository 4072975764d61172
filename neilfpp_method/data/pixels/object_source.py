"""What shows which pixels are the object: a mask file, the alpha channel, or a background of one colour."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from neilfpp_method.data.hulls.silhouettes import Outline, outline_of
from neilfpp_method.data.pixels.drawing import KNOWN, MASK
from neilfpp_method.data.pixels.store import PixelStore

__all__ = ["ObjectSource", "object_line", "object_sources", "stored_masks"]

ObjectSource = Literal["mask file", "alpha channel", "background of one colour", "nothing"]


def object_sources(store: PixelStore) -> list[ObjectSource]:
    """Return what shows the object in each view of a store."""
    return [_source(store, i) for i in range(len(store.views))]


def stored_masks(store: PixelStore) -> list[Outline]:
    """Return the mask file or the alpha channel of each view of a store that has one, reduced."""
    outlines = []
    for i, source in enumerate(object_sources(store)):
        if source in ("mask file", "alpha channel"):
            camera = store.views[i].camera
            mask = (store.bits[store.indices(i)] & MASK).astype(bool).reshape(camera.height, camera.width)
            outlines.append(outline_of(store.views[i], mask))
            store.release()
    return outlines


def object_line(sources: Sequence[ObjectSource]) -> str:
    """Return one line for the console on what shows the object in the views.

    >>> object_line(["alpha channel", "alpha channel", "nothing"])
    'object: shown by the alpha channel in 2 of 3 views'
    """
    counts = {source: sources.count(source) for source in dict.fromkeys(sources) if source != "nothing"}
    known = [
        f"the {source}" + (f" in {count} of {len(sources)} views" if count < len(sources) else "")
        for source, count in counts.items()
    ]
    if not known:
        return "object: no mask, alpha channel or background of one colour shows it; all pixels count"
    return f"object: shown by {' and '.join(known)}"


def _source(store: PixelStore, i: int) -> ObjectSource:
    if store.views[i].mask is not None:
        return "mask file"
    known = (store.bits[store.indices(i)] & KNOWN) > 0
    if not known.any():
        return "nothing"
    # An alpha channel decides on all pixels, a background of one colour only on the pixels that have it.
    decided = known.all() and (store.bits[store.indices(i)] & MASK).any()
    return "alpha channel" if decided else "background of one colour"
