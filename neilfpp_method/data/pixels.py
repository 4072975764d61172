"""All pixels of a capture's views in memory, drawn at random or view by view, with their rays in the scene frame."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Float32, Int
from torch import Tensor

from neilfpp_method.data.backdrop import MOST_RAYS, leaves_room
from neilfpp_method.data.capture import Capture
from neilfpp_method.data.drawing import ValidPixels
from neilfpp_method.data.images import ImageFile, read_image
from neilfpp_method.data.silhouettes import MOST_VIEWS, Outline
from neilfpp_method.data.views import CameraRays, View
from neilfpp_method.errors import UserError
from neilfpp_method.shading.color import luminance, srgb_to_linear, tone_map
from neilfpp_method.structures import PixelBatch

__all__ = ["PixelDataset", "pixel_colors"]

BORDER_TOLERANCE = 0.02
BORDER_SHARE = 0.5
DARK = 1e-3
MIDDLE_GREY = 0.18
SCHARR = torch.tensor([[-3.0, 0.0, 3.0], [-10.0, 0.0, 10.0], [-3.0, 0.0, 3.0]])
REPAIR = "repair the images, or mark the pixels in a validity mask"


class PixelDataset:
    """P pixels of the chosen views, view after view, row by row. `len` is P; `PixelBatch.view` counts in `views`.

    Colours, masks, validity and image gradients are stored, 19 bytes a pixel; rays are computed from the cameras when
    asked for. Colours of a linear capture are radiance on the scale that its views share: the exposure and the white
    balance of each view are divided out. A pixel is valid unless its view's validity mask is black there, or its view's
    lens shows nothing there.

    Args:
        capture: where the views come from.
        views: the views to load, for example `capture.train_views`.
        device: where the pixels are kept and drawn.
        on_view: called with the name of each view once it is loaded.

    Raises:
        UserError: an image cannot be read, has changed its size, or holds NaN, infinite or negative pixels that are not
            marked as invalid; a mask shows no object; no pixel is valid; or a view of display values has an exposure.
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
        cameras = [capture.normalisation.camera(view.camera) for view in views]
        self._rays = CameraRays(cameras, device)
        loaded = _load(self.views, capture.hdr, on_view)
        self._color, self._mask, self._mask_known, valid = (tensor.to(device) for tensor in loaded)
        valid &= torch.cat([self._rays.shown(i) for i in range(len(views))])
        if not valid.any():
            raise UserError(f"{capture.root}: no pixel is valid", "check the validity masks: white is valid")
        self._drawn = ValidPixels(valid)
        self._valid = self._drawn.valid
        sizes = [camera.width * camera.height for camera in cameras]
        self._starts = tuple(itertools.accumulate(sizes, initial=0))
        if not self._mask_known.any():
            self._mask_from_background()
        self._gradient = self._image_gradients()
        self._first = torch.tensor(self._starts[:-1], device=device)

    def __len__(self) -> int:
        return self._color.shape[0]

    def sample(self, count: int) -> PixelBatch:
        """`count` valid pixels drawn uniformly and independently from all views, by torch's global generator."""
        return self._batch(self.draw(count))

    def draw(self, count: int) -> Int[Tensor, " count"]:
        """The numbers of the pixels that `sample` would return, from 0 to P − 1."""
        return self._drawn.draw(count)

    def view(self, i: int) -> PixelBatch:
        """All pixels of `views[i]`, row by row; those that are not `valid` as well."""
        return self._batch(torch.arange(self._starts[i], self._starts[i + 1], device=self._color.device))

    def valid(self, i: int) -> Bool[Tensor, " N"]:
        """Which pixels of `views[i]` count: all but those that its validity mask, or its lens, leaves out."""
        return self._valid[self._starts[i] : self._starts[i + 1]]

    def _batch(self, index: Int[Tensor, " N"]) -> PixelBatch:
        view = torch.bucketize(index, self._first, right=True) - 1
        rays = self._rays(view, index - self._first[view])
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
        border = self._color[self._border()]
        if not len(border):
            return
        color = border.median(dim=0).values
        background = (self._color == color).all(dim=-1)
        if (border == color).all(dim=-1).float().mean() >= BORDER_SHARE and not background.all():
            self._mask, self._mask_known = ~background, background

    def _image_gradients(self) -> Float32[Tensor, " P"]:
        """How much the images change per pixel as they look: linear ones with the median of the object at middle grey."""
        lit = self._lit() if self.capture.hdr else ()
        exposure = MIDDLE_GREY / float(lit.median()) if len(lit) else 1.0
        gradients = []
        for view, (start, end) in zip(self.views, itertools.pairwise(self._starts), strict=True):
            color = self._color[start:end].view(view.camera.height, view.camera.width, 3)
            seen = tone_map(exposure * color) if self.capture.hdr else color
            gradients.append(_gradient(luminance(seen)).reshape(-1))
        return torch.cat(gradients)

    # ------------------------------------------------------------------------------------------------------- statistics

    def median_radiance(self) -> float:
        """The median luminance, linear, of the object: of valid pixels within the mask that are not black.

        Raises:
            UserError: there is no such pixel.
        """
        lit = self._lit()
        if not len(lit):
            raise UserError(f"{self.capture.root}: all pixels of the object are black", "check images and masks")
        return float(lit.median())

    def _lit(self) -> Float[Tensor, " L"]:
        """The luminance, linear, of the pixels of the object that are not black."""
        seen = luminance(self._linear(self._color[self._mask & self._valid]))
        return seen[seen > DARK * seen.mean()]

    def radiance_quantile(self, share: float) -> float:
        """The linear value that `share` of the values of all valid object pixels and channels do not exceed."""
        values = self._linear(self._color[self._mask & self._valid]).flatten()
        return float(values.kthvalue(max(1, round(share * len(values)))).values)

    def border_color(self) -> Float[Tensor, " 3"] | None:
        """The linear RGB that most pixels on the borders of the images share, or none.

        The border's median colour counts when half of the border shares it: differs from it by at most 2 % of the
        brighter of that colour and the object's median radiance. The rest must find room within the scene (`backdrop`):
        the colour of the ground is not that of the sky above.
        """
        numbers, color = self._border(), self.border_median()
        if not len(numbers):
            return None
        tolerance = BORDER_TOLERANCE * max(float(color.max()), self.median_radiance())

        def unlike(pixels: Int[Tensor, " N"] | slice) -> Bool[Tensor, " N"]:
            return (self._linear(self._color[pixels]) - color).abs().amax(dim=-1) > tolerance

        others = numbers[unlike(numbers)]
        if len(others) > (1 - BORDER_SHARE) * len(numbers):
            return None
        return color if self._within_the_scene(others, unlike) else None

    def border_median(self) -> Float[Tensor, " 3"]:
        """The median linear RGB of the borders of the images; black where no pixel there is valid."""
        border = self._linear(self._color[self._border()])
        return border.median(dim=0).values if len(border) else border.new_zeros(3)

    def _within_the_scene(self, numbers: Int[Tensor, " N"], other: Callable[[slice], Bool[Tensor, " V"]]) -> bool:
        """Whether what some pixels show can lie within the scene, as the views have it by which of their pixels are `other`."""
        if not len(numbers):
            return True
        chosen = self._batch(numbers[:: -(-len(numbers) // MOST_RAYS)].contiguous())
        outlines = []
        for i in range(0, len(self.views), -(-len(self.views) // MOST_VIEWS)):
            view, pixels = self.views[i], other(slice(self._starts[i], self._starts[i + 1]))
            outlines.append(Outline(view, pixels.view(view.camera.height, -1).cpu().numpy()))
        return leaves_room(outlines, chosen.rays, self.capture.normalisation)

    def _border(self) -> Int[Tensor, " B"]:
        """The numbers of the valid pixels on the borders of all images."""
        parts = []
        for view, (start, end) in zip(self.views, itertools.pairwise(self._starts), strict=True):
            number = torch.arange(start, end, device=self._color.device)
            image = number.view(view.camera.height, view.camera.width)
            parts += [image[0], image[-1], image[1:-1, 0], image[1:-1, -1]]
        border = torch.cat(parts)
        return border[self._valid[border]]

    def _linear(self, color: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
        return color if self.capture.hdr else srgb_to_linear(color)


class LoadedPixels(NamedTuple):
    """The pixels of all views, one after another."""

    color: Float32[Tensor, "P 3"]
    mask: Bool[Tensor, " P"]
    mask_known: Bool[Tensor, " P"]
    valid: Bool[Tensor, " P"]


def _load(views: Sequence[View], hdr: bool, on_view: Callable[[str], None] | None) -> LoadedPixels:
    total = sum(view.camera.width * view.camera.height for view in views)
    mask, known = torch.ones(total, dtype=torch.bool), torch.zeros(total, dtype=torch.bool)
    valid = torch.ones(total, dtype=torch.bool)
    pixels = LoadedPixels(torch.empty(total, 3), mask, known, valid)
    broken: list[tuple[View, int]] = []
    start = 0
    for view in views:
        image = _read(view)
        color = pixel_colors(view, image, hdr)
        usable = (color.isfinite() & (color >= 0)).all(dim=-1)
        rows = slice(start, start := start + view.camera.width * view.camera.height)
        if view.valid is not None:
            marked = _mask_file(view.valid, view)
            valid[rows] = marked.reshape(-1)
            color = torch.where((usable | marked)[..., None], color, 0.0)
            usable |= ~marked
        if count := int((~usable).sum()):
            broken.append((view, count))
        pixels.color[rows] = color.reshape(-1, 3)
        if (object_mask := _mask(view, image)) is not None:
            mask[rows], known[rows] = object_mask.reshape(-1), True
        if on_view:
            on_view(view.name)
    if broken:
        view, count = broken[0]
        others = f", and {len(broken) - 1} more images have such pixels" if len(broken) > 1 else ""
        raise UserError(f"{view.image}: {count} pixels are NaN, infinite or negative{others}", REPAIR)
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


def pixel_colors(view: View, image: ImageFile, hdr: bool) -> Float32[Tensor, "H W 3"]:
    """The pixels of a view; linear ones without its own exposure and white balance.

    Raises:
        UserError: display values with an exposure or a white balance.
    """
    color = torch.from_numpy(image.pixels).expand(-1, -1, 3)
    factors = view.exposure * torch.tensor(view.white_balance)
    if (factors == 1.0).all():
        return color
    if not hdr:
        # What is clipped at display values stays so at any exposure: no render could be compared with the quotient.
        raise UserError(
            f"{view.image}: an exposure or white balance for display values (sRGB)",
            "develop the images linearly, or expose them all alike and leave out the factors",
        )
    return color / factors


def _mask(view: View, image: ImageFile) -> Bool[Tensor, "H W"] | None:
    """The object: where the mask file, or without one the image's alpha, is above one half; none without either."""
    if view.mask is None and image.alpha is None:
        return None
    source = view.mask or view.image
    mask = _mask_file(view.mask, view) if view.mask else torch.from_numpy(image.alpha) > 0.5
    if not mask.any():
        raise UserError(f"{source}: the mask shows no object", "remove the view, or make the object's pixels white")
    return mask


def _mask_file(path: Path, view: View) -> Bool[Tensor, "H W"]:
    """Where a mask of the view is above one half."""
    values = read_image(path).pixels.max(axis=-1)
    if values.shape != (view.camera.height, view.camera.width):
        raise UserError(f"{path}: the mask has another size than {view.image}", "load the capture again")
    return torch.from_numpy(values) > 0.5


def _gradient(values: Float32[Tensor, "H W"]) -> Float32[Tensor, "H W"]:
    """The length of the Scharr gradient, without its 1/32: a ramp of 0.01 a pixel has 0.32. The borders are continued.

    L_smth weighs by its exponential (published code); with the factor no edge of a picture would count.
    """
    padded = torch.nn.functional.pad(values[None, None], (1, 1, 1, 1), mode="replicate")
    right, down = torch.nn.functional.conv2d(padded, torch.stack([SCHARR, SCHARR.T])[:, None].to(values))[0]
    return torch.hypot(right, down)
