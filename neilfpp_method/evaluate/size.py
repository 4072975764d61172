"""The size at which views are rendered: by default large enough to look at and to measure."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from neilfpp_method.data.scaling import (
    PIXELS_OF_A_VIEW,
    SAME,
    at_scale,
    file_size,
    scale_for_pixels,
    scale_for_width,
)
from neilfpp_method.errors import UserError
from neilfpp_method.train.run import Run

__all__ = ["at_size", "size_in_words", "what_is_measured"]


def at_size(run: Run, scale: float | None = None, width: int | None = None) -> Run:
    """The run with its views at another size; images, masks and truths are averaged over the area of a pixel.

    Args:
        run: the run; its own views have the size that it was trained at.
        scale: size over that of the files; 1 renders every pixel of a photograph.
        width: of the widest view, pixels. Without either, `PIXELS_OF_A_VIEW` pixels a view, and no more than
            the run was trained at.

    Raises:
        UserError: both are given, or one cannot be.
    """
    if scale is not None and width is not None:
        raise UserError("--scale and --width both say how large views are", "give one of them")
    views = run.capture.views
    if width is not None:
        scale = scale_for_width(views, width)
    if scale is None:
        trained = sum(view.camera.width * view.camera.height for view in views)
        if SAME**2 * trained <= PIXELS_OF_A_VIEW * len(views):
            return run
        scale = scale_for_pixels(views, PIXELS_OF_A_VIEW * len(views))
    return replace(run, capture=at_scale(run.capture, scale))


def size_in_words(run: Run) -> str | None:
    """How large the views of a run are and how to get larger ones; none where they have full size."""
    view = max(run.capture.views, key=lambda view: view.camera.width)
    width, height = view.camera.width, view.camera.height
    if (width, height) == file_size(view):
        return None
    files = "×".join(map(str, file_size(view)))
    return f"views of {width}×{height} pixels, files of {files}; --width or --scale for another size"


def what_is_measured(run: Run) -> dict[str, Any]:
    """Which views figures are of, at what size in pixels, and after how many steps: what has to agree for
    figures of two runs to be compared. The size is that of the widest view.
    """
    views = run.capture.test_views
    widest = max((view.camera for view in views), key=lambda camera: camera.width)
    names = [view.name for view in views]
    return {"view_names": names, "width": widest.width, "height": widest.height, "step": run.step}
