"""All pixels of a capture's views in memory, drawn at random or view by view, with their rays in the scene frame."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int
from torch import Tensor

from neilfpp_method.data.capture import Capture
from neilfpp_method.data.images import ImageFile, read_image
from neilfpp_method.data.views import View, pixel_rays
from neilfpp_method.errors import UserError
from neilfpp_method.shading.color import luminance, srgb_to_linear, tone_map
from neilfpp_method.structures import PixelBatch

__all__ = ["PixelDataset"]

BORDER_TOLERANCE = 0.02
BORDER_SHARE = 0.5
DARK = 1e-3


class PixelDataset:
    """P pixels of the chosen views, view after view, row by row. `len` is P; `PixelBatch.view` counts in `views`.

    Colours, masks and image gradients are stored, 17 bytes a pixel; rays are computed from the cameras when asked for.

    Args:
        capture: where the views come from.
        views: the views to load, for example `capture.train_views`.
        device: where the pixels are kept and drawn.
        on_view: called with the name of each view once it is loaded.

    Raises:
        UserError: an image cannot be read, has changed its size, or holds NaN, infinite or negative pixels, or a mask
            shows no object.
    """

    def __init__(
        self,
        capture: Capture,
        views: Sequence[View],
        device: torch.device | str = "cpu",
        on_view: Callable[[str], None] | None = None,
    ) -> None:
        if not views:
            raise UserError(f"{capture.root}: no views to load", "hold out fewer views, or more")
        self.capture = capture
        self.views = tuple(views)
        loaded = _load(self.views, capture.hdr, on_view)
        self._color, self._mask, self._mask_known, self._gradient = (tensor.to(device) for tensor in loaded)
        cameras = [capture.normalisation.camera(view.camera) for view in views]
        sizes = [camera.width * camera.height for camera in cameras]
        self._starts = tuple(itertools.accumulate(sizes, initial=0))
        if not self._mask_known.any():
            self._mask_from_background()
        self._first = torch.tensor(self._starts[:-1], device=device)
        self._width = torch.tensor([camera.width for camera in cameras], device=device)
        self._intrinsics = torch.tensor(np.stack([c.intrinsics for c in cameras]), dtype=torch.float32, device=device)
        self._c2w = torch.tensor(np.stack([c.c2w for c in cameras]), dtype=torch.float32, device=device)

    def __len__(self) -> int:
        return self._color.shape[0]

    def sample(self, count: int) -> PixelBatch:
        """`count` pixels drawn uniformly and independently from all views, by torch's global generator."""
        return self._batch(torch.randint(len(self), (count,), device=self._color.device))

    def view(self, i: int) -> PixelBatch:
        """All pixels of `views[i]`, row by row."""
        span = self._starts[i], self._starts[i + 1]
        return self._batch(torch.arange(*span, device=self._color.device))

    def _batch(self, index: Int[Tensor, " N"]) -> PixelBatch:
        view = torch.bucketize(index, self._first, right=True) - 1
        local, width = index - self._first[view], self._width[view]
        rays = pixel_rays(self._intrinsics[view], self._c2w[view], local % width, local // width)
        return PixelBatch(
            origins=rays.origins,
            directions=rays.directions,
            color=self._color[index],
            mask=self._mask[index].to(self._color.dtype),
            mask_known=self._mask_known[index].to(self._color.dtype),
            image_gradient=self._gradient[index],
            view=view,
        )

    def _mask_from_background(self) -> None:
        """Without masks, pixels of exactly the colour of most of the border are off the object; of the others nothing is known.

        Rendered captures, and clipped backdrops, have such pixels; in front of a noisy backdrop hardly any pixel is exact.
        """
        border = torch.cat([self._border(i) for i in range(len(self.views))])
        color = border.median(dim=0).values
        background = (self._color == color).all(dim=-1)
        if (border == color).all(dim=-1).float().mean() >= BORDER_SHARE and not background.all():
            self._mask, self._mask_known = ~background, background

    # ------------------------------------------------------------------------------------------------------- statistics

    def median_radiance(self) -> float:
        """The median luminance, linear, of the object: of pixels within the mask that are not black.

        Raises:
            UserError: there is no such pixel.
        """
        seen = luminance(self._linear(self._color[self._mask]))
        lit = seen[seen > DARK * seen.mean()]
        if not len(lit):
            raise UserError(f"{self.capture.root}: all pixels of the object are black", "check images and masks")
        return float(lit.median())

    def radiance_quantile(self, share: float) -> float:
        """The linear value that `share` of the values of all object pixels and channels do not exceed."""
        values = self._linear(self._color[self._mask]).flatten()
        return float(values.kthvalue(max(1, round(share * len(values)))).values)

    def border_color(self) -> Float[Tensor, " 3"] | None:
        """The linear RGB that most pixels on the borders of the images share, or none.

        The border's median colour counts when half of the border shares it: differs from it by at most 2 % of the
        brighter of that colour and the object's median radiance.
        """
        border = self._linear(torch.cat([self._border(i) for i in range(len(self.views))]))
        color = border.median(dim=0).values
        tolerance = BORDER_TOLERANCE * max(float(color.max()), self.median_radiance())
        share = ((border - color).abs().amax(dim=-1) <= tolerance).float().mean()
        return color if share >= BORDER_SHARE else None

    def _border(self, i: int) -> Float[Tensor, "B 3"]:
        camera = self.views[i].camera
        image = self._color[self._starts[i] : self._starts[i + 1]].view(camera.height, camera.width, 3)
        return torch.cat([image[0], image[-1], image[1:-1, 0], image[1:-1, -1]])

    def _linear(self, color: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
        return color if self.capture.hdr else srgb_to_linear(color)


class LoadedPixels(NamedTuple):
    """The pixels of all views, one after another."""

    color: Float32[Tensor, "P 3"]
    mask: Bool[Tensor, " P"]
    mask_known: Bool[Tensor, " P"]
    image_gradient: Float32[Tensor, " P"]


def _load(views: Sequence[View], hdr: bool, on_view: Callable[[str], None] | None) -> LoadedPixels:
    total = sum(view.camera.width * view.camera.height for view in views)
    mask, known = torch.ones(total, dtype=torch.bool), torch.zeros(total, dtype=torch.bool)
    pixels = LoadedPixels(torch.empty(total, 3), mask, known, torch.empty(total))
    broken: list[tuple[View, int]] = []
    start = 0
    for view in views:
        image = _read(view)
        color = torch.from_numpy(image.pixels).expand(-1, -1, 3)
        if count := int((~(color.isfinite() & (color >= 0)).all(dim=-1)).sum()):
            broken.append((view, count))
        rows = slice(start, start := start + view.camera.width * view.camera.height)
        pixels.color[rows] = color.reshape(-1, 3)
        if (object_mask := _mask(view, image)) is not None:
            mask[rows], known[rows] = object_mask.reshape(-1), True
        pixels.image_gradient[rows] = _gradient(luminance(tone_map(color) if hdr else color)).reshape(-1)
        if on_view:
            on_view(view.name)
    if broken:
        view, count = broken[0]
        others = f", and {len(broken) - 1} more images have such pixels" if len(broken) > 1 else ""
        raise UserError(f"{view.image}: {count} pixels are NaN, infinite or negative{others}", "repair the images")
    return pixels


def _read(view: View) -> ImageFile:
    image = read_image(view.image)
    height, width = image.pixels.shape[:2]
    if (width, height) != (view.camera.width, view.camera.height):
        raise UserError(
            f"{view.image}: {width}×{height} pixels where the camera has {view.camera.width}×{view.camera.height}",
            "load the capture again",
        )
    return image


def _mask(view: View, image: ImageFile) -> Bool[Tensor, "H W"] | None:
    """The object: where the mask file, or without one the image's alpha, is above one half; none without either."""
    height, width = image.pixels.shape[:2]
    if view.mask is None and image.alpha is None:
        return None
    source = view.mask or view.image
    values = image.alpha if view.mask is None else read_image(view.mask).pixels.max(axis=-1)
    if values.shape != (height, width):
        raise UserError(f"{source}: the mask has another size than {view.image}", "load the capture again")
    mask = torch.from_numpy(values) > 0.5
    if not mask.any():
        raise UserError(f"{source}: the mask shows no object", "remove the view, or make the object's pixels white")
    return mask


def _gradient(values: Float32[Tensor, "H W"]) -> Float32[Tensor, "H W"]:
    """The length of the gradient per pixel, by central differences; the borders are continued."""
    padded = torch.nn.functional.pad(values[None, None], (1, 1, 1, 1), mode="replicate")[0, 0]
    right = (padded[1:-1, 2:] - padded[1:-1, :-2]) / 2
    down = (padded[2:, 1:-1] - padded[:-2, 1:-1]) / 2
    return torch.hypot(right, down)
