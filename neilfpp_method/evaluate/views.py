"""Rendered views of a run, and the images and true maps of the same views, for metrics and pictures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np
import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from neilfpp_method.data.cameras.projection import camera_rays, pixel_index, project
from neilfpp_method.data.capture import Capture
from neilfpp_method.data.pixels.dataset import PixelDataset
from neilfpp_method.data.split import TEST_EVERY
from neilfpp_method.data.truth import Truth
from neilfpp_method.data.views import View
from neilfpp_method.errors import UserError
from neilfpp_method.model import EVAL_RAYS
from neilfpp_method.shading.color import srgb_to_linear
from neilfpp_method.structures import Maps
from neilfpp_method.train.run import Run

__all__ = [
    "HeldOut",
    "KnownView",
    "RenderedView",
    "evenly_spread",
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
    """The maps of one rendered view, float32, by their names in `structures.Maps`. Colours are linear."""

    name: str
    maps: Mapping[str, Float[np.ndarray, "H W C"]]

    @property
    def surface_mask(self) -> Bool[np.ndarray, "H W"]:
        """Pixels that show a surface: opacity above one half."""
        return self.maps["opacity"][..., 0] > 0.5


def render_view(
    run: Run, view_index: int, on_progress: Callable[[float], None] = lambda share: None
) -> RenderedView:
    """Render view `view_index` of `run.capture.views` at the size of its camera. Deterministic.

    Rays are processed in batches of `EVAL_RAYS`. Each batch is spread over the whole view, so
    that all batches take about the same time; `on_progress` is called with the fraction that is done after
    each. If the run has no material yet, `rgb` is the host's colour, and the maps of the material are 0.
    """
    view = run.capture.views[view_index]
    device, render = run.device, run.model.maps if run.has_material else run.model.host_maps
    rays = camera_rays(run.capture.scene_camera(view))
    parts = -(-len(rays) // EVAL_RAYS)
    combined: dict[str, Tensor] = {}
    for k in range(parts):
        rows = torch.arange(k, len(rays), parts)
        maps = render(rays[rows].to(device))
        for name in (f.name for f in fields(Maps)):
            values = getattr(maps, name).float().cpu()
            combined.setdefault(name, values.new_empty(len(rays), values.shape[1]))[rows] = values
        on_progress((k + 1) / parts)
    return RenderedView(view.name, {name: _image(values, view) for name, values in combined.items()})


def evenly_spread(names: Sequence[str], count: int) -> tuple[str, ...]:
    """Choose `count` of the names at even distances, or all if there are fewer.

    >>> evenly_spread("abcde", 3)
    ('a', 'c', 'e')
    """
    rows = np.linspace(0, len(names) - 1, min(count, len(names))).round().astype(int)
    return tuple(names[row] for row in rows)


def render_test_views(
    run: Run, on_progress: Callable[[float], None] = lambda share: None
) -> tuple[RenderedView, ...]:
    """Render every held-out view, in order; `on_progress` is called with the fraction that is done.

    Raises:
        UserError: no view is held out.
    """
    held_out = [i for i, view in enumerate(run.capture.views) if view.name in run.capture.test]
    if not held_out:
        every = min(TEST_EVERY, len(run.capture.views))
        raise UserError(
            f"{run.capture.root}: no view is held out for testing", f"train with --test-every {every}"
        )
    rendered = []
    for i in held_out:
        rendered.append(
            render_view(run, i, lambda share: on_progress((len(rendered) + share) / len(held_out)))
        )
    return tuple(rendered)


# ------------------------------------------------------------------------------------------------------ truth


@dataclass(frozen=True)
class KnownView:
    """The captured image of a view, and its true maps as far as the capture has them.

    Attributes:
        view: the view.
        image: the image as captured: linear radiance, or display values in [0, 1].
        mask: the pixels that metrics count.
        depth: true depth along the camera's axis, scene units, or None.
        normal: true unit normals, scene frame, or None.
        material: true maps base_color, roughness and metallic by name, or None.
    """

    view: View
    image: Float[np.ndarray, "H W 3"]
    mask: Bool[np.ndarray, "H W"]
    depth: Float[np.ndarray, "H W"] | None
    normal: Float[np.ndarray, "H W 3"] | None
    material: Mapping[str, Float[np.ndarray, "H W C"]] | None


@dataclass(frozen=True)
class HeldOut:
    """The test views, and the source of their masks (see `mask_source`)."""

    views: tuple[KnownView, ...]
    mask_source: str


def mask_source(capture: Capture) -> str:
    """Name the source of the masks of the test views; it is the same for all of them.

    Returns:
        "true depth" if every test view has a true depth map; else "capture masks" if any view has a mask, or
        pixels that show exactly the background; else "rendered opacity", a threshold of one half on the
        estimate. With the last, the estimate chooses the pixels on which it is measured.
    """
    return _mask_source(_known_depths(capture), _file_values(capture, capture.test_views))


def known_test_views(run: Run, rendered: Sequence[RenderedView]) -> HeldOut:
    """Load images, masks and true maps of the test views.

    Masks come from the source that `mask_source` names; pixels that the capture marks as invalid are removed.

    Args:
        run: the run.
        rendered: the rendered test views, in order.
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
    """The pixels of views with the precision of their files; training stores them in fewer bits."""
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


# ------------------------------------------------------------------------------- observed colours of surfaces

MAX_DEPTH_DIFFERENCE = 0.02
"""A view sees a point if its depth map, at the point's pixel, differs by at most this, scene units."""


def surface_points(capture: Capture, known: KnownView) -> Float[Tensor, "P 3"]:
    """Points of the true surface at the masked pixels of a view with true depth, scene frame."""
    camera = capture.scene_camera(known.view)
    rays = camera_rays(camera)[torch.from_numpy(known.mask).reshape(-1)]
    cosine = rays.directions @ torch.as_tensor(camera.w2c[2, :3], dtype=rays.directions.dtype)
    return rays.origins + rays.directions * (torch.from_numpy(known.depth[known.mask]) / cosine)[:, None]


def mean_observed_color(capture: Capture, points: Float[Tensor, "P 3"]) -> Float[np.ndarray, "P 3"] | None:
    """Mean linear colour of surface points over the training views that see them.

    A point that no view sees gets the mean over all others.

    Args:
        capture: the capture.
        points: surface points, scene frame.

    Returns:
        Linear colours, or None if no training view has true depth.
    """
    truth = Truth(capture)
    views = [view for view in capture.train_views if truth.depth(view) is not None]
    if not views:
        return None
    pixels = _file_values(capture, views)
    total, count = torch.zeros_like(points), torch.zeros(len(points), 1)
    for i, view in enumerate(views):
        projected = project(capture.scene_camera(view), points)
        index = pixel_index(projected, view.camera)
        same_depth = (truth.depth(view)[index] - projected.depth).abs() <= MAX_DEPTH_DIFFERENCE
        visible = (index >= 0) & pixels.valid(i)[index] & same_depth
        color = pixels.view(i, gradients=False).color[index]
        total += visible[:, None] * (color if capture.hdr else srgb_to_linear(color))
        count += visible[:, None]
    mean = total / count.clamp_min(1)
    average = total.sum(0) / count.sum().clamp_min(1)
    return torch.where(count > 0, mean, average).numpy()
