"""All pixels of a capture's views, drawn at random or view by view, with their rays in the scene frame."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int
from torch import Tensor

from neilfpp_method.data.backdrop import MAX_RAYS, leaves_room
from neilfpp_method.data.capture import Capture
from neilfpp_method.data.drawing import KNOWN, MASK, NEAR, VALID, PixelDraws
from neilfpp_method.data.pixel_store import PixelStore, border, expect_draws, load_pixels
from neilfpp_method.data.silhouettes import MAX_VIEWS, Outline
from neilfpp_method.data.views import CameraRays, View
from neilfpp_method.errors import UserError
from neilfpp_method.shading.color import luminance, srgb_to_linear, tone_map
from neilfpp_method.structures import PixelBatch

__all__ = ["PixelDataset"]

BORDER_TOLERANCE = 0.02
BORDER_SHARE = 0.5
DARK = 1e-3
MIDDLE_GREY = 0.18
NEIGHBOURS = np.array([(row, column) for row in (-1, 0, 1) for column in (-1, 0, 1)])
"""Rows and columns of the nine values about a pixel."""
MAX_COUNTED = 2**20
"""Pixels of the object, evenly over all views, from which statistics are computed."""


class PixelDataset:
    """P pixels of the chosen views, view after view, row by row. `PixelBatch.view` indexes `views`.

    Colours, masks and validity are kept in a `PixelStore`, 4 to 13 bytes a pixel, in a folder or in memory;
    rays and image gradients are computed when asked for. Colours of a linear capture are radiance on the
    scale that its views share: the exposure and the white balance of each view are divided out. A pixel is
    valid unless its view's validity mask is black there, or its view's lens shows nothing there.

    Args:
        capture: where the views come from.
        views: the views to load, for example `capture.train_views`.
        device: where batches go. Pixels are drawn, and read, on the CPU.
        on_view: called with the name of each view once it is read.
        folder: where the pixels are kept, and found again by the next who asks; none: in memory.
        exact: keep colours in single precision, as the files have them, to compare with; needs `folder` to be
            none.

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
            raise UserError(f"{capture.root}: no views to load", "hold out fewer views, or more")
        self.capture = capture
        self.views = tuple(views)
        self.device = torch.device(device)
        self._rays = CameraRays([capture.normalisation.camera(view.camera) for view in views], device)
        self.store: PixelStore = load_pixels(self.views, capture.hdr, self._shown, folder, on_view, exact)
        self._draws = PixelDraws(self.store.bits, len(self.store))
        if not self._draws.valid.count:
            raise UserError(f"{capture.root}: no pixel is valid", "check the validity masks: white is valid")
        expect_draws(self.store)

    def _shown(self, i: int) -> Bool[np.ndarray, " N"]:
        return self._rays.shown(i).cpu().numpy()

    def on(self, device: torch.device | str) -> PixelDataset:
        """The same pixels, with batches on another device."""
        other = copy.copy(self)
        other.device = torch.device(device)
        cameras = [self.capture.normalisation.camera(view.camera) for view in self.views]
        other._rays = CameraRays(cameras, device)
        return other

    def __len__(self) -> int:
        return len(self.store)

    def sample(self, count: int, gradients: bool = True) -> PixelBatch:
        """`count` valid pixels from torch's global generator, most on or near the object (`data.drawing`).

        Image gradients take nine reads a pixel; without `gradients` they are 0.
        """
        numbers = self.draw(count).numpy()
        views = self._views_of(numbers)
        colors = self.store.colors(numbers, views)
        return self._batch(numbers, views, colors, self._gradients_at(numbers, views) if gradients else None)

    def draw(self, count: int) -> Int[Tensor, " count"]:
        """The numbers of the pixels that `sample` would return, from 0 to P − 1."""
        return self._draws.draw(count)

    def leave_out(self, numbers: Int[Tensor, " N"]) -> None:
        """Draw these pixels no more; see `data.held_back`."""
        self._draws.leave_out(numbers)

    def numbered(self, numbers: Int[Tensor, " N"]) -> PixelBatch:
        """Pixels by their numbers, in that order; without image gradients."""
        chosen = numbers.cpu().numpy()
        views = self._views_of(chosen)
        return self._batch(chosen, views, self.store.colors(chosen, views), None)

    def view(self, i: int, gradients: bool = True) -> PixelBatch:
        """All pixels of `views[i]`, row by row, invalid ones included. Image gradients as in `sample`."""
        rows, camera = self.store.rows(i), self.views[i].camera
        numbers, colors = np.arange(rows.start, rows.stop), self.store.view_colors(i)
        shape = camera.height, camera.width
        gradient = _gradient(self._seen(colors).view(shape)).reshape(-1) if gradients else None
        return self._batch(numbers, np.full(len(numbers), i), colors, gradient)

    def at(self, i: int, rows: Int[Tensor, " N"]) -> PixelBatch:
        """Some pixels of `views[i]`, by their number in the view, row by row; without image gradients."""
        numbers = self.store.rows(i).start + rows.cpu().numpy()
        views = np.full(len(numbers), i)
        return self._batch(numbers, views, self.store.colors(numbers, views), None)

    def valid(self, i: int) -> Bool[Tensor, " N"]:
        """Which pixels of `views[i]` count: all but those that its validity mask, or its lens, leaves out."""
        return self._bit(self.store.bits[self.store.rows(i)], VALID)

    def near(self, i: int) -> Bool[Tensor, " N"]:
        """Which pixels of `views[i]` are on or near the object; none where nothing is known of it."""
        return self._bit(self.store.bits[self.store.rows(i)], NEAR)

    def _views_of(self, numbers: Int[np.ndarray, " N"]) -> Int[np.ndarray, " N"]:
        return np.searchsorted(self.store.starts, numbers, side="right") - 1

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
            mask_known=self._bit(bits, KNOWN).float(),
            image_gradient=torch.zeros(len(numbers), device=self.device)
            if gradient is None
            else gradient.to(self.device),
            view=view,
        )

    # ---------------------------------------------------------------------------------------- image gradients

    @cached_property
    def _exposure(self) -> float:
        """Brings the median of the object to middle grey, where pixels are linear."""
        lit = self._lit() if self.capture.hdr else ()
        return MIDDLE_GREY / float(lit.median()) if len(lit) else 1.0

    def _seen(self, colors: Float32[np.ndarray, "*shape 3"]) -> Float32[Tensor, "*shape"]:
        """Luminance of the images as they look: linear ones with the median of the object at middle grey."""
        color = torch.from_numpy(colors)
        return luminance(tone_map(self._exposure * color) if self.capture.hdr else color)

    def _gradients_at(
        self, numbers: Int[np.ndarray, " N"], views: Int[np.ndarray, " N"]
    ) -> Float32[Tensor, " N"]:
        """How much the images change per pixel as they look, at single pixels; see `_gradient`."""
        size = np.array([(view.camera.width, view.camera.height) for view in self.views])[views]
        at = numbers - self.store.starts[views]
        column, row, last = at % size[:, 0], at // size[:, 0], size - 1
        columns = np.clip(column + NEIGHBOURS[:, 1, None], 0, last[:, 0])
        rows = np.clip(row + NEIGHBOURS[:, 0, None], 0, last[:, 1])
        around = self.store.starts[views] + rows * size[:, 0] + columns
        seen = self._seen(self.store.colors(around, np.broadcast_to(views, around.shape)))
        return _scharr(seen.unbind(0))

    # --------------------------------------------------------------------------------------------- statistics

    def median_radiance(self) -> float:
        """The median luminance, linear, of the object: of valid pixels within the mask that are not black.

        Of more than `MAX_COUNTED` pixels so many are counted, evenly over the views.

        Raises:
            UserError: there is no such pixel.
        """
        lit = self._lit()
        if not len(lit):
            raise UserError(
                f"{self.capture.root}: all pixels of the object are black", "check images and masks"
            )
        return float(lit.median())

    def radiance_quantile(self, share: float) -> float:
        """The linear value that `share` of the values of valid object pixels and channels stay below."""
        values = self._of_the_object().flatten()
        return float(values.kthvalue(max(1, round(share * len(values)))).values)

    def _lit(self) -> Float[Tensor, " L"]:
        """The luminance, linear, of the pixels of the object that are not black."""
        seen = luminance(self._of_the_object())
        return seen[seen > DARK * seen.mean()]

    def _of_the_object(self) -> Float[Tensor, "S 3"]:
        """The linear colours of valid pixels within the mask: all, or every so many-th."""
        step = -(-len(self) // MAX_COUNTED)
        colors = []
        for i in range(len(self.views)):
            rows = self.store.rows(i)
            wanted = VALID | MASK
            numbers = rows.start + np.flatnonzero((self.store.bits[rows] & wanted) == wanted)[::step]
            colors.append(self.store.colors(numbers, np.full(len(numbers), i)))
            self.store.release()
        return self._linear(np.concatenate(colors))

    def border_color(self) -> Float[Tensor, " 3"] | None:
        """The linear RGB that most pixels on the borders of the images share, or none.

        The border's median colour counts when half of the border shares it: differs from it by at most 2 % of
        the brighter of that colour and the object's median radiance. The rest must find room within the scene
        (`backdrop`): the colour of the ground is not that of the sky above.
        """
        numbers, views = border(self.store)
        color = self.border_median()
        if not len(numbers):
            return None
        tolerance = BORDER_TOLERANCE * max(float(color.max()), self.median_radiance())

        def unlike(colors: Float32[np.ndarray, "N 3"]) -> Bool[Tensor, " N"]:
            return (self._linear(colors) - color).abs().amax(dim=-1) > tolerance

        others = unlike(self.store.colors(numbers, views)).numpy()
        if others.sum() > (1 - BORDER_SHARE) * len(numbers):
            return None
        return color if self._within_the_scene(numbers[others], views[others], unlike) else None

    def border_median(self) -> Float[Tensor, " 3"]:
        """The median linear RGB of the borders of the images; black where no pixel there is valid."""
        colors = self._linear(self.border_colors())
        return colors.median(dim=0).values if len(colors) else colors.new_zeros(3)

    def border_colors(self) -> Float32[np.ndarray, "B 3"]:
        """The colours of the valid pixels on the borders of the images."""
        return self.store.colors(*border(self.store))

    def _within_the_scene(
        self,
        numbers: Int[np.ndarray, " N"],
        views: Int[np.ndarray, " N"],
        other: Callable[[Float32[np.ndarray, "V 3"]], Bool[Tensor, " V"]],
    ) -> bool:
        """Whether what these pixels show can lie in the scene, judged by which pixels are `other`."""
        if not len(numbers):
            return True
        step = -(-len(numbers) // MAX_RAYS)
        number, view = numbers[::step], torch.from_numpy(np.ascontiguousarray(views[::step])).to(self.device)
        rays = self._rays(view, torch.from_numpy(number - self.store.starts[views[::step]]).to(self.device))
        outlines = []
        for i in range(0, len(self.views), -(-len(self.views) // MAX_VIEWS)):
            inside = other(self.store.view_colors(i)).view(self.views[i].camera.height, -1)
            outlines.append(Outline(self.views[i], inside.numpy()))
            self.store.release()
        return leaves_room(outlines, rays, self.capture.normalisation)

    def _linear(self, colors: Float32[np.ndarray, "*shape"]) -> Float32[Tensor, "*shape"]:
        color = torch.from_numpy(colors)
        return color if self.capture.hdr else srgb_to_linear(color)


def _gradient(values: Float32[Tensor, "H W"]) -> Float32[Tensor, "H W"]:
    """`_scharr` of a whole image; the borders are continued."""
    padded = torch.nn.functional.pad(values[None, None], (1, 1, 1, 1), mode="replicate")[0, 0]
    height, width = values.shape
    return _scharr(
        [padded[1 + row : 1 + row + height, 1 + column : 1 + column + width] for row, column in NEIGHBOURS]
    )


def _scharr(about: Sequence[Float32[Tensor, "*shape"]]) -> Float32[Tensor, "*shape"]:
    """The length of the Scharr gradient from the nine values about each pixel, in the order of `NEIGHBOURS`.

    Without its factor of 1/32: a ramp of 0.01 a pixel has 0.32.

    L_smth weighs by its exponential (published code); with the factor no edge of a picture would count.
    """
    right = 3 * (about[2] - about[0]) + 10 * (about[5] - about[3]) + 3 * (about[8] - about[6])
    down = 3 * (about[6] - about[0]) + 10 * (about[7] - about[1]) + 3 * (about[8] - about[2])
    return torch.hypot(right, down)
