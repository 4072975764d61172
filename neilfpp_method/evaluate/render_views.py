"""Write rendered views to disk: a PNG per map for display, and one layered EXR per view with the values."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from neilfpp_method.data.files.images import write_exr, write_png
from neilfpp_method.evaluate.confidence import measure_residuals, with_deviation
from neilfpp_method.evaluate.pictures import display
from neilfpp_method.evaluate.views import RenderedView, render_view
from neilfpp_method.train.run import Run, check_material

__all__ = ["finished_views", "render_run"]

LAYERS = {"normal": "XYZ"}
"""Channel names of EXR layers that are not RGB."""
RENDERING_SHARE = 0.95
"""Fraction of the progress of a view that rendering takes; the rest is for writing."""


def render_run(
    run: Run,
    out: Path,
    views: Sequence[str] = ("test",),
    overwrite: bool = False,
    confidence: bool = False,
    on_progress: Callable[[float], None] = lambda share: None,
) -> list[Path]:
    """Render views of a run to `<out>/<map>/<view>.png` for display and `<out>/<view>.exr` with all maps.

    The EXR of a view is written last, and views whose EXR exists are skipped, so an interrupted render can be
    continued. In the EXR, a map with several channels is a layer (`base_color.R`, `normal.X`) and a map with
    one channel has its own name. Colours are linear; normals and depths are in the scene frame.

    Args:
        run: the trained run.
        out: the folder to write.
        views: names of views, or of groups of views: "test", "train", "all".
        overwrite: also render views whose EXR exists.
        confidence: also write the expected errors of base colour, roughness and metallic
            (`confidence.with_deviation`).
        on_progress: called with the fraction of the work that is done.

    Returns:
        The EXR files, in the order of the capture.

    Raises:
        UserError: the capture has no such view, or `confidence` is set and the run has no material yet.
    """
    names = {view.name for view in run.capture.chosen_views(views)}
    kept = set() if overwrite else set(finished_views(run, out, views, confidence))
    if confidence:
        check_material(run)
    residuals = measure_residuals(run) if confidence else None
    written = []
    for i, view in enumerate(run.capture.views):
        if view.name not in names:
            continue
        written.append(out / f"{view.name}.exr")
        if view.name not in kept:
            done = len(written) - 1
            rendered = render_view(
                run, i, lambda share, done=done: on_progress((done + RENDERING_SHARE * share) / len(names))
            )
            _write(rendered if residuals is None else with_deviation(run, residuals, rendered), out)
        on_progress(len(written) / len(names))
    return written


def finished_views(run: Run, out: Path, views: Sequence[str], confidence: bool = False) -> list[str]:
    """Return the names of the views that `render_run` does not render again, because their files exist.

    Raises:
        UserError: the capture has no such view.
    """
    return [
        view.name
        for view in run.capture.chosen_views(views)
        if (out / f"{view.name}.exr").exists()
        and (not confidence or _picture(out, "base_color_std", view.name).exists())
    ]


def _write(view: RenderedView, out: Path) -> None:
    # The depth of a ray that hits nothing is meaningless, so it must not affect the range of the PNG.
    surface_depth = np.where(view.maps["opacity"] > 0.5, view.maps["depth"], np.nan)
    for name, values in {**view.maps, "depth": surface_depth}.items():
        write_png(_picture(out, name, view.name), display(name, values))
    channels = {key: plane for name, values in view.maps.items() for key, plane in _channels(name, values)}
    write_exr(out / f"{view.name}.exr", channels)


def _picture(out: Path, map_name: str, view_name: str) -> Path:
    return out / map_name / f"{view_name}.png"


def _channels(
    name: str, values: Float[np.ndarray, "H W C"]
) -> Iterator[tuple[str, Float[np.ndarray, "H W"]]]:
    if values.shape[-1] == 1:
        yield name, values[..., 0]
        return
    for i, letter in enumerate(LAYERS.get(name, "RGB")):
        yield f"{name}.{letter}", values[..., i]
