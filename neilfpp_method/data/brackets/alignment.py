"""Alignment of hand-held exposure brackets with their middle exposure, before they are merged.

Images of neighbouring exposures are registered, because they have the most unclipped pixels in common, and
the motions are chained. The camera's response is not needed: the values of one image are first mapped to
those of the other by histogram matching (Grossberg and Nayar, 2003), which a small motion hardly changes.
Median threshold bitmaps (OpenCV) give the initial shift. Inverse compositional least squares from coarse to
fine (Baker and Matthews, 2004) give a homography, the motion of an image when the camera rotates.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64

from neilfpp_method.data.brackets.merging import MAX_VALUE, MIN_VALUE, Bracket

__all__ = ["Aligned", "align"]

SIDES = (128, 256, 512, 1024)
"""Longer sides of the reduced images that are registered, in pixels, from coarse to fine."""
ROUNDS = 20
"""Largest number of Gauss–Newton steps per size."""
CONVERGED_MOTION = 0.01
"""Motion of a Gauss–Newton step, in pixels of the reduced image, below which the iteration ends."""
MIN_SHIFT = 0.25
"""Smallest corner motion, in pixels, for which an image is resampled; resampling blurs."""
MAX_RESIDUAL = 0.8
"""Largest ratio of the image difference after a motion to that before it with which a motion is accepted."""
MAX_SHIFT = 0.15
"""Largest accepted corner motion, as a share of the longer side; a larger one is taken for a failure."""
MIN_OVERLAP = 0.02
"""Smallest share of pixels that must be unclipped in both images."""
SHIFT_BITS = 5
"""Base-2 logarithm of the largest shift of the coarse alignment, in pixels of the reduced image."""


@dataclass(frozen=True)
class Aligned:
    """An aligned bracket.

    Attributes:
        bracket: the images; pixels that an image does not show after its motion, or had clipped, are 1.
        moved: largest corner motion that was corrected, in pixels; 0 if no image was resampled.
    """

    bracket: Bracket
    moved: float


def align(bracket: Bracket) -> Aligned:
    """Align all images of a bracket with the middle exposure.

    An image that cannot be registered gets the motion of its neighbour in exposure.
    """
    order = [int(i) for i in np.argsort(bracket.exposures)]
    middle = len(order) // 2
    motions = {order[middle]: np.eye(3)}
    for outward in (order[middle:], order[middle::-1]):
        for inner, outer in pairwise(outward):
            motions[outer] = _motion(bracket.pixels[inner], bracket.pixels[outer]) @ motions[inner]
    size = bracket.pixels[0].shape[:2]
    moved = {i: _corner_shift(motion, size) for i, motion in motions.items()}
    pixels = tuple(
        _moved(image, motions[i]) if moved[i] > MIN_SHIFT else image for i, image in enumerate(bracket.pixels)
    )
    return Aligned(
        Bracket(pixels, bracket.exposures),
        max((shift for shift in moved.values() if shift > MIN_SHIFT), default=0.0),
    )


# ----------------------------------------------------------------------------------------------------- motion


def _motion(
    fixed: Float32[np.ndarray, "H W 3"], moving: Float32[np.ndarray, "H W 3"]
) -> Float64[np.ndarray, "3 3"]:
    """The homography from pixels of `fixed` to pixels of `moving`; the identity if none fits better."""
    size = fixed.shape[:2]
    still = np.eye(3)
    pair = _pair(fixed, moving, SIDES[1])
    if min(pair.moving_usable.mean(), pair.fixed_usable.mean()) < MIN_OVERLAP:
        return still
    starts = [still, _first_shift(pair)]
    motion = min(starts, key=lambda start: _difference(pair, start))
    for side in SIDES:
        pair = _pair(fixed, moving, side)
        motion = _refined(pair, motion)
        if side >= max(size):
            break
    far = not np.isfinite(motion).all() or _corner_shift(motion, size) > MAX_SHIFT * max(size)
    useless = _difference(pair, motion) > MAX_RESIDUAL * _difference(pair, still)
    return still if far or useless else motion


@dataclass(frozen=True)
class _Pair:
    """Two exposures, reduced and in grey, with the values of the second mapped to those of the first.

    Attributes:
        fixed: the first image.
        moving: the second image.
        fixed_usable: pixels of the first image that are neither dark nor clipped.
        moving_usable: pixels of the second image that are neither dark nor clipped.
        scale: the map from reduced to full pixels. Motions are given in full pixels.
    """

    fixed: Float32[np.ndarray, "h w"]
    moving: Float32[np.ndarray, "h w"]
    fixed_usable: Bool[np.ndarray, "h w"]
    moving_usable: Bool[np.ndarray, "h w"]
    scale: Float64[np.ndarray, "3 3"]

    def warped(
        self, motion: Float64[np.ndarray, "3 3"]
    ) -> tuple[Float32[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
        """The second image after a motion, and the pixels that are usable in both images."""
        reduced = np.linalg.inv(self.scale) @ motion @ self.scale
        size, flags = self.fixed.shape[::-1], cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        usable = cv2.warpPerspective(self.moving_usable.astype(np.float32), reduced, size, flags=flags) > 0.99
        return cv2.warpPerspective(self.moving, reduced, size, flags=flags), usable & self.fixed_usable


def _pair(fixed: Float32[np.ndarray, "H W 3"], moving: Float32[np.ndarray, "H W 3"], side: int) -> _Pair:
    height, width = fixed.shape[:2]
    share = min(1.0, side / max(height, width))
    size = (max(2, round(share * width)), max(2, round(share * height)))
    small = [cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in (fixed, moving)]
    usable = [(image.max(axis=2) < MAX_VALUE) & (image.max(axis=2) > MIN_VALUE) for image in small]
    first, second = (image.mean(axis=2) for image in small)
    steps = np.linspace(0, 1, 256)
    matched = np.interp(second, np.quantile(second, steps), np.quantile(first, steps)).astype(np.float32)
    across, down = width / size[0], height / size[1]
    # The centre of the first pixel is (0, 0), as in OpenCV.
    scale = np.array([[across, 0, (across - 1) / 2], [0, down, (down - 1) / 2], [0, 0, 1]])
    return _Pair(first, matched, *usable, scale)


def _first_shift(pair: _Pair) -> Float64[np.ndarray, "3 3"]:
    """The initial shift, by median threshold bitmaps."""
    levels = [np.rint(255 * image).astype(np.uint8) for image in (pair.fixed, pair.moving)]
    x, y = cv2.createAlignMTB(max_bits=SHIFT_BITS).calculateShift(*levels)
    motion = np.eye(3)
    motion[:2, 2] = -x, -y
    return pair.scale @ motion @ np.linalg.inv(pair.scale)


def _refined(pair: _Pair, motion: Float64[np.ndarray, "3 3"]) -> Float64[np.ndarray, "3 3"]:
    """The homography that minimises the difference of the images up to gain and offset, from an initial one.

    Inverse compositional Gauss–Newton: the derivatives are those of the fixed image, computed once.
    """
    height, width = pair.fixed.shape
    unit = max(height, width) / 2
    rows, columns = np.mgrid[:height, :width].astype(np.float32)
    x, y = (columns - (width - 1) / 2) / unit, (rows - (height - 1) / 2) / unit
    dx, dy = (cv2.Sobel(pair.fixed, cv2.CV_32F, *axis, ksize=3, scale=unit / 8) for axis in ((1, 0), (0, 1)))
    along = dx * x + dy * y
    slopes = np.stack(
        [dx * x, dx * y, dx, dy * x, dy * y, dy, -along * x, -along * y, pair.fixed, np.ones_like(x)]
    )
    centered = pair.scale @ np.array([[unit, 0, (width - 1) / 2], [0, unit, (height - 1) / 2], [0, 0, 1]])
    for _ in range(ROUNDS):
        warped, usable = pair.warped(motion)
        if usable.mean() < MIN_OVERLAP:
            break
        difference, usable_slopes = (warped - pair.fixed)[usable], slopes[:, usable]
        typical = 1.5 * np.median(np.abs(difference - np.median(difference))) + 1e-4
        # Huber weights, because objects that move independently of the camera are outliers.
        weighted = usable_slopes / np.maximum(np.abs(difference - np.median(difference)) / typical, 1.0)
        step = np.linalg.lstsq(weighted @ usable_slopes.T, weighted @ difference, rcond=1e-9)[0]
        small = np.eye(3) + np.append(step[:8], 0).reshape(3, 3)
        change = centered @ np.linalg.inv(small) @ np.linalg.inv(centered)
        motion = motion @ change
        motion = motion / motion[2, 2]
        if _corner_shift(change, (height, width)) < CONVERGED_MOTION:
            break
    return motion


def _difference(pair: _Pair, motion: Float64[np.ndarray, "3 3"]) -> float:
    """The difference of the images after a motion: 1 − their correlation over the usable pixels."""
    warped, usable = pair.warped(motion)
    if usable.mean() < MIN_OVERLAP:
        return 1.0
    a, b = pair.fixed[usable] - pair.fixed[usable].mean(), warped[usable] - warped[usable].mean()
    return 1.0 - float((a * b).mean() / max(a.std() * b.std(), 1e-12))


def _corner_shift(motion: Float64[np.ndarray, "3 3"], size: tuple[int, int]) -> float:
    """The largest motion of an image corner, in pixels."""
    height, width = size
    corners = np.array([[0, 0], [width - 1, 0], [0, height - 1], [width - 1, height - 1]], np.float64)
    return float(np.linalg.norm(cv2.perspectiveTransform(corners[None], motion)[0] - corners, axis=1).max())


def _moved(
    image: Float32[np.ndarray, "H W 3"], motion: Float64[np.ndarray, "3 3"]
) -> Float32[np.ndarray, "H W 3"]:
    """The image warped to the middle exposure; 1 where a clipped or missing pixel contributes."""
    size, flags = image.shape[1::-1], cv2.WARP_INVERSE_MAP
    moved = cv2.warpPerspective(
        image, motion, size, flags=cv2.INTER_CUBIC | flags, borderMode=cv2.BORDER_REPLICATE
    )
    clipped = cv2.dilate((image >= MAX_VALUE).astype(np.float32), np.ones((3, 3), np.uint8))
    unseen = cv2.warpPerspective(
        clipped, motion, size, flags=cv2.INTER_LINEAR | flags, borderValue=(1.0, 1.0, 1.0)
    )
    return np.where(unseen > 1e-3, np.float32(1.0), moved.clip(0, 1))
