"""The size at which views are rendered, by default limited to what measurements and displays need."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from neilfpp_method.data.scaling import (
    MIN_REDUCING_SCALE,
    PIXELS_OF_A_VIEW,
    at_scale,
    file_size,
    scale_for_pixels,
    scale_for_width,
)
from neilfpp_method.errors import UserError
from neilfpp_method.train.run import Run

__all__ = ["at_size", "describe_size", "measured_views"]


def at_size(run: Run, scale: float | None = None, width: int | None = None) -> Run:
    """Return the run with its views at another size; images, masks and truth are averaged over pixel areas.

    If neither `scale` nor `width` is given, views keep the size that the run was trained at, but are reduced
    to a mean of `PIXELS_OF_A_VIEW` pixels if they are larger.

    Args:
        run: the run, whose views have the size that it was trained at.
        scale: size relative to the image files; 1 renders every pixel of a photograph.
        width: width of the widest view, pixels.

    Raises:
        UserError: both `scale` and `width` are given, or one has an impossible value.
    """
    if scale is not None and width is not None:
        raise UserError("--scale and --width both set the size of views", "give only one of them")
    views = run.capture.views
    if width is not None:
        scale = scale_for_width(views, width)
    if scale is None:
        trained = sum(view.camera.width * view.camera.height for view in views)
        if MIN_REDUCING_SCALE**2 * trained <= PIXELS_OF_A_VIEW * len(views):
            return run
        scale = scale_for_pixels(views, PIXELS_OF_A_VIEW * len(views))
    return replace(run, capture=at_scale(run.capture, scale))


def describe_size(run: Run) -> str | None:
    """One line on the size of a run's views and how to change it; None if they have the size of the files."""
    view = max(run.capture.views, key=lambda view: view.camera.width)
    width, height = view.camera.width, view.camera.height
    if (width, height) == file_size(view):
        return None
    files = "×".join(map(str, file_size(view)))
    return f"views have {width}×{height} pixels, the files {files}; --width or --scale changes the size"


def measured_views(run: Run) -> dict[str, Any]:
    """Describe what figures were measured on: names of the test views, size of the widest one, training step.

    Figures of two runs can be compared only if the views and the size agree.
    """
    views = run.capture.test_views
    widest = max((view.camera for view in views), key=lambda camera: camera.width)
    names = [view.name for view in views]
    return {"view_names": names, "width": widest.width, "height": widest.height, "step": run.step}
