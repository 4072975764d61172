"""Second implementations that the tests of several protocols share, pixel by pixel in plain Python."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np

from neilfpp_method.data.capture import Capture, load_capture
from neilfpp_method.data.views import View
from neilfpp_method.evaluate.views import RenderedView
from neilfpp_method.train.run import Run
from tests.evaluate.test_protocols import KnownSphere, make_run


def similarity(estimate: np.ndarray, truth: np.ndarray, window: int, beyond: str) -> np.ndarray:
    """SSIM of every pixel and channel, from sums over each window."""
    half = window // 2
    weights = {
        (dy, dx): math.exp(-(dy * dy + dx * dx) / (2 * 1.5**2))
        for dy in range(-half, half + 1)
        for dx in range(-half, half + 1)
    }
    total = sum(weights.values())
    height, width, _ = truth.shape

    def at(image: np.ndarray, y: int, x: int, c: int) -> float:
        if beyond == "mirror":
            y = abs(y) if y < height else 2 * (height - 1) - y
            x = abs(x) if x < width else 2 * (width - 1) - x
        return float(image[y, x, c]) if 0 <= y < height and 0 <= x < width else 0.0

    result = np.zeros(truth.shape)
    for y, x, c in np.ndindex(*truth.shape):
        pairs = [
            (w / total, at(estimate, y + dy, x + dx, c), at(truth, y + dy, x + dx, c))
            for (dy, dx), w in weights.items()
        ]
        a, b = sum(w * e for w, e, _ in pairs), sum(w * t for w, _, t in pairs)
        aa, bb = (
            sum(w * (e - a) ** 2 for w, e, _ in pairs),
            sum(w * (t - b) ** 2 for w, _, t in pairs),
        )
        # Relative to the means: the sum of weights is 1, so this equals E[x²] − E[x]².
        ab = sum(w * (e - a) * (t - b) for w, e, t in pairs)
        result[y, x, c] = (2 * a * b + 1e-4) * (2 * ab + 9e-4) / ((a * a + b * b + 1e-4) * (aa + bb + 9e-4))
    return result


def srgb(linear: float) -> float:
    return 12.92 * linear if linear <= 0.0031308 else 1.055 * linear ** (1 / 2.4) - 0.055


def linear(code: float) -> float:
    return code / 12.92 if code <= 0.04045 else ((code + 0.055) / 1.055) ** 2.4


def unit(vector: np.ndarray) -> np.ndarray:
    return vector / math.sqrt(sum(float(v) ** 2 for v in vector))


def run_with_images(root: Path, images: dict[str, Path], hdr: bool = False) -> Run:
    """A run of the capture in `root` whose test views have these images, by view."""
    capture: Capture = load_capture(root)
    views = tuple(moved(view, images.get(view.name)) for view in capture.views)
    return make_run(dataclasses.replace(capture, views=views, hdr=hdr), KnownSphere())


def moved(view: View, image: Path | None) -> View:
    return view if image is None else dataclasses.replace(view, image=image)


def random_view(name: str, height: int, width: int, seed: int) -> RenderedView:
    """Maps of random values: opacity from 0 to 1, normals of unit length."""
    draw = np.random.default_rng(seed)
    normal = draw.normal(size=(height, width, 3))
    maps = {
        "rgb": draw.uniform(0, 1.2, (height, width, 3)),
        "base_color": draw.uniform(0.01, 1, (height, width, 3)),
        "roughness": draw.uniform(0, 1, (height, width, 1)),
        "normal": normal / np.linalg.norm(normal, axis=-1, keepdims=True),
        "opacity": draw.choice([0.0, 0.3, 1.0], (height, width, 1)),
        "depth": draw.uniform(1, 2, (height, width, 1)),
    }
    return RenderedView(name, {key: values.astype(np.float32) for key, values in maps.items()})
