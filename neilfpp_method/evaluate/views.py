"""What a run shows of a view, and what is known of it: made once, then measured, drawn or written."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np
import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from neilfpp_method.data.capture import Capture
from neilfpp_method.data.pixels import PixelDataset
from neilfpp_method.data.truth import Truth
from neilfpp_method.data.views import View, camera_rays, project
from neilfpp_method.errors import UserError
from neilfpp_method.shading.color import srgb_to_linear
from neilfpp_method.structures import Maps
from neilfpp_method.train.run import Run

__all__ = [
    "HeldOut",
    "KnownView",
    "RenderedView",
    "known_test_views",
    "mask_source",
    "mean_observed_color",
    "render_test_views",
    "render_view",
    "surface_points",
]


# -------------------------------------------------------------------------------------------------- estimates


@dataclass(frozen=True)
class RenderedView:
    """The maps of one view by their names in `structures.Maps`, (H, W, C) float32. Colours are linear."""

    name: str
    maps: Mapping[str, Float[np.ndarray, "H W C"]]


def render_view(
    run: Run, view_index: int, on_progress: Callable[[float], None] = lambda share: None
) -> RenderedView:
    """Render view `view_index` of `run.capture.views` at the size of its camera; the same picture every time.

    `config.train.eval_chunk` rays are in flight at once, from all over the view, so that each such part takes
    about as long as any other; the share that is done is reported after each. A run without a material has
    the host's colour for `rgb`, and zeros for what a material would show.
    """
    view = run.capture.views[view_index]
    device = next(run.model.parameters()).device
    rays = camera_rays(run.capture.normalisation.camera(view.camera))
    parts = -(-len(rays) // run.config.train.eval_chunk)
    whole: dict[str, Tensor] = {}
    for k in range(parts):
        rows = torch.arange(k, len(rays), parts)
        maps = run.model.maps(rays[rows].to(device), run.has_material)
        for name in (f.name for f in fields(Maps)):
            values = getattr(maps, name).float().cpu()
            whole.setdefault(name, values.new_empty(len(rays), values.shape[1]))[rows] = values
        on_progress((k + 1) / parts)
    return RenderedView(view.name, {name: _image(values, view) for name, values in whole.items()})


def render_test_views(
    run: Run, on_progress: Callable[[float], None] = lambda share: None
) -> tuple[RenderedView, ...]:
    """Render every view that is held out, in order; reports the share that is done as it goes.

    Raises:
        UserError: no view is held out.
    """
    held_out = [i for i, view in enumerate(run.capture.views) if view.name in run.capture.test]
    if not held_out:
        raise UserError(f"{run.capture.root}: no view is held out for testing", "train with --test-every 8")
    rendered = []
    for i in held_out:
        rendered.append(
            render_view(run, i, lambda share: on_progress((len(rendered) + share) / len(held_out)))
        )
    return tuple(rendered)


# ------------------------------------------------------------------------------------------------------ truth


@dataclass(frozen=True)
class KnownView:
    """What is known of a view: `image` as captured, the pixels that count, and the truth where known.

    `depth` is along the camera's axis, scene units; `material` maps base_color, roughness and metallic.
    """

    view: View
    image: Float[np.ndarray, "H W 3"]
    mask: Bool[np.ndarray, "H W"]
    depth: Float[np.ndarray, "H W"] | None
    normal: Float[np.ndarray, "H W 3"] | None
    material: Mapping[str, Float[np.ndarray, "H W C"]] | None


@dataclass(frozen=True)
class HeldOut:
    """The test views, and what decides which of their pixels count, as `mask_source` names it."""

    views: tuple[KnownView, ...]
    mask_source: str


def mask_source(capture: Capture) -> str:
    """What decides which pixels of the test views count; one source for all of them.

    "true depth" where every view has it; else "capture masks" where there are any, or where pixels that show
    exactly the background stand for them; else "rendered opacity" above one half, which lets the estimate
    choose its pixels.
    """
    return _mask_source(_known_depths(capture), _file_values(capture, capture.test_views))


def known_test_views(run: Run, rendered: Sequence[RenderedView]) -> HeldOut:
    """What is known of the test views; `rendered` are the same views, in order.

    Masks are as `mask_source` says, without the pixels that the capture marks as invalid.
    """
    capture, truth = run.capture, Truth(run.capture)
    depths, stored = _known_depths(capture), _file_values(capture, capture.test_views)
    source = _mask_source(depths, stored)
    masks = {
        "true depth": lambda i: depths[i] > 0,
        "capture masks": lambda i: stored.view(i, gradients=False).mask > 0.5,
        "rendered opacity": lambda i: torch.from_numpy(rendered[i].maps["opacity"] > 0.5),
    }[source]
    views = []
    for i, view in enumerate(capture.test_views):
        normal, material = truth.normal(view), truth.material(view)
        views.append(
            KnownView(
                view=view,
                image=_image(stored.view(i, gradients=False).color, view),
                mask=_image(masks(i).reshape(-1) & stored.valid(i), view)[..., 0],
                depth=None if depths[i] is None else _image(depths[i], view)[..., 0],
                normal=None if normal is None else _image(normal, view),
                material=material
                and {f.name: _image(getattr(material, f.name), view) for f in fields(material)},
            )
        )
    return HeldOut(tuple(views), source)


def _file_values(capture: Capture, views: Sequence[View]) -> PixelDataset:
    """The pixels of views as their files have them, which a training keeps in fewer bits."""
    return PixelDataset(capture, views, exact=True)


def _known_depths(capture: Capture) -> list[Float[Tensor, " P"] | None]:
    truth = Truth(capture)
    return [truth.depth(view) for view in capture.test_views]


def _mask_source(depths: Sequence[Tensor | None], stored: PixelDataset) -> str:
    if all(depth is not None for depth in depths):
        return "true depth"
    masked = any((stored.view(i, gradients=False).mask < 1).any() for i in range(len(depths)))
    return "capture masks" if masked else "rendered opacity"


def _image(values: Shaped[Tensor, "P ..."], view: View) -> Shaped[np.ndarray, "H W C"]:
    return values.reshape(view.camera.height, view.camera.width, -1).numpy()


# --------------------------------------------------------------------------------------- what other views saw

VISIBLE = 0.02
"""Largest difference from a view's depth map, scene units, at which the view sees a point."""


def surface_points(capture: Capture, known: KnownView) -> Float[Tensor, "P 3"]:
    """Where the masked pixels of a view meet the true surface, scene frame; the view must have its depth."""
    camera = capture.normalisation.camera(known.view.camera)
    rays = camera_rays(camera)[torch.from_numpy(known.mask).reshape(-1)]
    along_axis = rays.directions @ torch.as_tensor(camera.w2c[2, :3], dtype=rays.directions.dtype)
    return rays.origins + rays.directions * (torch.from_numpy(known.depth[known.mask]) / along_axis)[:, None]


def mean_observed_color(capture: Capture, points: Float[Tensor, "P 3"]) -> Float[np.ndarray, "P 3"] | None:
    """The mean linear colour of surface points over training views that see them; none without true depths.

    A view sees a point when its depth map, at the point's pixel, agrees within `VISIBLE`. A point that no
    view sees takes the mean over the others.
    """
    truth = Truth(capture)
    views = [view for view in capture.train_views if truth.depth(view) is not None]
    if not views:
        return None
    pixels = _file_values(capture, views)
    total, count = torch.zeros_like(points), torch.zeros(len(points), 1)
    for i, view in enumerate(views):
        size = torch.tensor([view.camera.width, view.camera.height])
        seen = project(capture.normalisation.camera(view.camera), points)
        inside = (seen.depth > 0) & (seen.pixel >= 0).all(-1) & (seen.pixel < size).all(-1)
        column, row = torch.where(inside[:, None], seen.pixel, 0.0).long().unbind(-1)
        index = row * view.camera.width + column
        visible = inside & pixels.valid(i)[index] & ((truth.depth(view)[index] - seen.depth).abs() <= VISIBLE)
        color = pixels.view(i, gradients=False).color[index]
        total += visible[:, None] * (color if capture.hdr else srgb_to_linear(color))
        count += visible[:, None]
    mean = total / count.clamp_min(1)
    average = total.sum(0) / count.sum().clamp_min(1)
    return torch.where(count > 0, mean, average).numpy()
