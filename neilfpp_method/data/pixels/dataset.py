"""The pixels of the views of a capture, at random or view by view, with their rays in the scene frame."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64, Int
from torch import Tensor

from neilfpp_method.data.cameras.projection import CameraRays
from neilfpp_method.data.capture import Capture
from neilfpp_method.data.pixels.drawing import KNOWN, MASK, NEAR, VALID, PixelDraws, PixelSet
from neilfpp_method.data.pixels.gradient import NEIGHBORS, image_gradient, scharr
from neilfpp_method.data.pixels.store import PixelStore, advise_random_access, load_pixels
from neilfpp_method.data.views import View
from neilfpp_method.errors import UserError
from neilfpp_method.shading.color import luminance, srgb_to_linear, tone_map
from neilfpp_method.structures import PixelBatch

__all__ = ["BACKGROUND_TRUST", "PixelDataset"]

DARK = 1e-3
"""Luminance below which a pixel counts as black, relative to the mean of the object."""

MIDDLE_GRAY = 0.18
"""Linear value to which the median of the object is brought for image gradients: photographic middle grey."""

BACKGROUND_TRUST = 0.1
"""`mask_known` of pixels whose mask is known only because they have exactly the background colour. It is low
because parts of the object may have that colour as well.
"""

MAX_COUNTED = 2**20
"""Largest number of object pixels, evenly drawn from all views, from which statistics are computed."""


class PixelDataset:
    """P pixels of the chosen views, view after view, row by row. `PixelBatch.view` indexes `views`.

    Colours, masks and validity are stored in a `PixelStore`, with 4 to 13 bytes per pixel, in a folder or in
    memory; rays and image gradients are computed on demand. Colours of a linear capture are radiance on the
    scale that all views share: exposure and white balance of each view are divided out. A pixel is invalid if
    the validity mask of its view is black there, or if no ray passes the lens there.

    Args:
        capture: the capture.
        views: the views to load, for example `capture.train_views`.
        device: device of the batches. Pixels are drawn and read on the CPU.
        on_view: called with the name of each view when it has been read.
        folder: folder in which the pixels are stored and from which they are read the next time; None: in
            memory.
        exact: store colours in single precision, without loss; requires that `folder` is None.

    Raises:
        UserError: an image cannot be read, has changed its size, or holds NaN, infinite or negative pixels
            that are not marked as invalid; a mask shows no object; no pixel is valid; a view of display
            values has an exposure; or the folder cannot be written.
    """

    def __init__(
        self,
        capture: Capture,
        views: Sequence[View],
        device: torch.device | str = "cpu",
        on_view: Callable[[str], None] | None = None,
        folder: Path | None = None,
        *,
        exact: bool = False,
    ) -> None:
        if not views:
            raise UserError(
                f"{capture.root}: no views to load", "leave views of both kinds, to train on and to test on"
            )
        self.capture = capture
        self.views = tuple(views)
        self.device = torch.device(device)
        self._rays = CameraRays([capture.scene_camera(view) for view in views], device)
        self.store: PixelStore = load_pixels(self.views, capture.hdr, self._has_ray, folder, on_view, exact)
        self._draws = PixelDraws(self.store.bits, len(self.store))
        self._trust = 1.0 if PixelSet(self.store.bits, KNOWN | MASK).count else BACKGROUND_TRUST
        if not self._draws.valid.count:
            raise UserError(f"{capture.root}: no pixel is valid", "check the validity masks: white is valid")
        advise_random_access(self.store)

    def _has_ray(self, i: int) -> Bool[np.ndarray, " N"]:
        return self._rays.has_ray(i).cpu().numpy()

    def on(self, device: torch.device | str) -> PixelDataset:
        """Return the same pixels, with batches on another device."""
        other = copy.copy(self)
        other.device = torch.device(device)
        cameras = [self.capture.scene_camera(view) for view in self.views]
        other._rays = CameraRays(cameras, device)
        return other

    def posed(self, capture: Capture) -> PixelDataset:
        """Return the same pixels with the poses of the views of the same names in another capture."""
        other, views = copy.copy(self), {view.name: view for view in capture.views}
        other.capture, other.views = capture, tuple(views[view.name] for view in self.views)
        other._rays = self._rays.posed([capture.scene_camera(view) for view in other.views])
        return other

    def __len__(self) -> int:
        return len(self.store)

    def sample(self, count: int, gradients: bool = True) -> PixelBatch:
        """Draw `count` valid pixels with torch's global generator, most on or near the object
        (`data.pixels.drawing`).

        Image gradients take nine reads per pixel; without `gradients` they are 0.
        """
        numbers = self.draw(count).numpy()
        views = self.store.views_of(numbers)
        colors = self.store.colors(numbers, views)
        return self._batch(numbers, views, colors, self._gradients_at(numbers, views) if gradients else None)

    def draw(self, count: int) -> Int[Tensor, " count"]:
        """Draw the indices of the pixels that `sample` would return, from 0 to P − 1."""
        return self._draws.draw(count)

    def view_of(self, numbers: Int[Tensor, " N"]) -> Int[Tensor, " N"]:
        """Return the index of the view of each pixel."""
        return torch.from_numpy(self.store.views_of(numbers.cpu().numpy()))

    def leave_out(self, numbers: Int[Tensor, " N"]) -> None:
        """Exclude pixels from all later draws; see `data.pixels.held_back`."""
        self._draws.leave_out(numbers)

    def numbered(self, numbers: Int[Tensor, " N"]) -> PixelBatch:
        """Return pixels by index, in the given order, without image gradients."""
        chosen = numbers.cpu().numpy()
        views = self.store.views_of(chosen)
        return self._batch(chosen, views, self.store.colors(chosen, views), None)

    def view(self, i: int, gradients: bool = True) -> PixelBatch:
        """Return all pixels of `views[i]`, row by row, also invalid ones. Image gradients as in `sample`."""
        indices, camera = self.store.indices(i), self.views[i].camera
        numbers, colors = np.arange(indices.start, indices.stop), self.store.view_colors(i)
        gradient = None
        if gradients:
            luminances = self._display_luminance(colors).view(camera.height, camera.width)
            gradient = image_gradient(luminances).float().reshape(-1)
        return self._batch(numbers, np.full(len(numbers), i), colors, gradient)

    def at(self, i: int, pixel: Int[Tensor, " N"]) -> PixelBatch:
        """Return pixels of `views[i]` by their index in the view, without image gradients."""
        numbers = self.store.indices(i).start + pixel.cpu().numpy()
        views = np.full(len(numbers), i)
        return self._batch(numbers, views, self.store.colors(numbers, views), None)

    def valid(self, i: int) -> Bool[Tensor, " N"]:
        """Return which pixels of `views[i]` are valid."""
        return self._bit(self.store.bits[self.store.indices(i)], VALID)

    def near(self, i: int) -> Bool[Tensor, " N"]:
        """Return which pixels of `views[i]` are on or near the object; all false if the object is unknown."""
        return self._bit(self.store.bits[self.store.indices(i)], NEAR)

    def _bit(self, bits: np.ndarray, bit: int) -> Bool[Tensor, " N"]:
        return torch.from_numpy((bits & bit) > 0).to(self.device)

    def _batch(
        self,
        numbers: Int[np.ndarray, " N"],
        views: Int[np.ndarray, " N"],
        colors: Float32[np.ndarray, "N 3"],
        gradient: Float32[Tensor, " N"] | None,
    ) -> PixelBatch:
        bits = self.store.bits[numbers]
        view = torch.from_numpy(views).to(self.device)
        rays = self._rays(view, torch.from_numpy(numbers - self.store.starts[views]).to(self.device))
        return PixelBatch(
            origins=rays.origins,
            directions=rays.directions,
            color=torch.from_numpy(colors).to(self.device),
            mask=self._bit(bits, MASK).float(),
            mask_known=self._trust * self._bit(bits, KNOWN).float(),
            image_gradient=torch.zeros(len(numbers), device=self.device)
            if gradient is None
            else gradient.to(self.device),
            view=view,
        )

    # ---------------------------------------------------------------------------------------- image gradients

    @cached_property
    def _exposure(self) -> float:
        """Factor that brings the median of the object to middle grey; 1 if pixels are display values."""
        positive = self._positive_luminance() if self.capture.hdr else ()
        return MIDDLE_GRAY / float(positive.median()) if len(positive) else 1.0

    def _display_luminance(self, colors: Float32[np.ndarray, "*shape 3"]) -> Float64[Tensor, "*shape"]:
        """Display luminance; linear images are exposed so that the median of the object is middle grey.

        In float64: the last bit of a float32 result depends on how many pixels are computed at once, and
        then the gradient of a pixel drawn alone would differ from its gradient in a whole view.
        """
        color = torch.from_numpy(colors).double()
        return luminance(tone_map(self._exposure * color) if self.capture.hdr else color)

    def _gradients_at(
        self, numbers: Int[np.ndarray, " N"], views: Int[np.ndarray, " N"]
    ) -> Float32[Tensor, " N"]:
        """Image gradients at single pixels; see `scharr`."""
        size = np.array([(view.camera.width, view.camera.height) for view in self.views])[views]
        at = numbers - self.store.starts[views]
        column, row, last = at % size[:, 0], at // size[:, 0], size - 1
        columns = np.clip(column + NEIGHBORS[:, 1, None], 0, last[:, 0])
        rows = np.clip(row + NEIGHBORS[:, 0, None], 0, last[:, 1])
        around = self.store.starts[views] + rows * size[:, 0] + columns
        colors = self.store.colors(around, np.broadcast_to(views, around.shape))
        return scharr(self._display_luminance(colors).unbind(0)).float()

    # --------------------------------------------------------------------------------------------- statistics

    def median_radiance(self) -> float:
        """Return the median linear luminance of the valid object pixels that are not black.

        At most `MAX_COUNTED` pixels are read, evenly drawn from all views.

        Raises:
            UserError: there is no such pixel.
        """
        positive = self._positive_luminance()
        if not len(positive):
            raise UserError(
                f"{self.capture.root}: all pixels of the object are black",
                "check images and masks: white is the object",
            )
        return float(positive.median())

    def radiance_quantile(self, share: float) -> float:
        """Return the `share`-quantile of the linear values of all channels of valid object pixels."""
        values = self._of_the_object().flatten()
        return float(values.kthvalue(max(1, round(share * len(values)))).values)

    def _positive_luminance(self) -> Float[Tensor, " L"]:
        """Linear luminance of the object pixels that are not black."""
        values = luminance(self._of_the_object())
        return values[values > DARK * values.mean()]

    def _of_the_object(self) -> Float[Tensor, "S 3"]:
        """Linear colours of valid object pixels, evenly spaced if there are more than `MAX_COUNTED`."""
        step = -(-len(self) // MAX_COUNTED)
        colors = []
        for i in range(len(self.views)):
            indices, wanted = self.store.indices(i), VALID | MASK
            chosen = np.flatnonzero((self.store.bits[indices] & wanted) == wanted)[::step]
            numbers = indices.start + chosen
            colors.append(self.store.colors(numbers, np.full(len(numbers), i)))
            self.store.release()
        return self.linear(np.concatenate(colors))

    def linear(self, colors: Float32[np.ndarray, "*shape"]) -> Float32[Tensor, "*shape"]:
        """Return the linear values of stored colours."""
        color = torch.from_numpy(colors)
        return color if self.capture.hdr else srgb_to_linear(color)
