"""Views of a run on disk: a PNG per map to look at, and one layered EXR per view that holds the values."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float

from neilfpp_method.data.capture import Capture
from neilfpp_method.data.images import write_exr, write_png
from neilfpp_method.errors import UserError
from neilfpp_method.evaluate.confidence import gather_evidence, with_deviation
from neilfpp_method.evaluate.pictures import display
from neilfpp_method.evaluate.views import RenderedView, render_view
from neilfpp_method.train.run import Run

__all__ = ["render_run"]

LAYERS = {"normal": "XYZ"}
PART = 0.95
"""Share of the work on a view that is rendering; the rest is writing."""


def render_run(
    run: Run,
    out: Path,
    views: str | Collection[str] = "test",
    overwrite: bool = False,
    confidence: bool = False,
    on_progress: Callable[[float], None] = lambda share: None,
) -> list[Path]:
    """Render views of a run: `<out>/<map>/<view>.png` to look at, and `<out>/<view>.exr` with all maps.

    A view is written with its EXR last, and one whose EXR is there is skipped: a render that was stopped goes
    on where it was. In the EXR a map is a layer (`base_color.R`, `normal.X`), or one channel by its own name;
    colours are linear, normals and depths in the scene frame.

    Args:
        run: the trained run.
        out: the folder to write.
        views: "test", "train", "all", or names of views.
        overwrite: render again what is there.
        confidence: also write how far off base colour, roughness and metallic may be
            (`confidence.with_deviation`).
        on_progress: told the share that is done, as it goes.

    Returns:
        The EXR files, in the order of the capture.

    Raises:
        UserError: a view that the capture does not have, or confidence of a material that is not there yet.
    """
    names = view_names(run.capture, views)
    if confidence and not run.has_material:
        raise UserError(f"{run.path}: there is no material at step {run.step}", "train the next stage")
    evidence = gather_evidence(run) if confidence else None
    written = []
    for i, view in enumerate(run.capture.views):
        if view.name not in names:
            continue
        written.append(out / f"{view.name}.exr")
        complete = written[-1].exists() and (
            not confidence or _picture(out, "base_color_std", view.name).exists()
        )
        if overwrite or not complete:
            done = len(written) - 1
            rendered = render_view(
                run, i, lambda share, done=done: on_progress((done + PART * share) / len(names))
            )
            _write(rendered if evidence is None else with_deviation(run, evidence, rendered), out)
        on_progress(len(written) / len(names))
    return written


def view_names(capture: Capture, views: str | Collection[str]) -> frozenset[str]:
    """The views meant by "test", "train", "all" or by their names.

    Raises:
        UserError: the capture has no such view.
    """
    everything = frozenset(view.name for view in capture.views)
    groups = {"all": everything, "test": capture.test, "train": everything - capture.test}
    if isinstance(views, str) and views in groups:
        return groups[views]
    wanted = frozenset([views] if isinstance(views, str) else views)
    if missing := sorted(wanted - everything):
        raise UserError(
            f"{capture.root}: there is no view '{missing[0]}'", "give test, train, all, or names of views"
        )
    return wanted


def _write(view: RenderedView, out: Path) -> None:
    # Where a ray meets nothing its depth means nothing; the picture's range is that of the surface.
    seen = np.where(view.maps["opacity"] > 0.5, view.maps["depth"], np.nan)
    for name, values in {**view.maps, "depth": seen}.items():
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
