"""A capture under a sky: the ground has one colour and covers most of the image borders; the sky has another
one.
"""

from __future__ import annotations

from pathlib import Path

import torch

from neilfpp_method.data.capture import load_capture
from neilfpp_method.data.files.images import write_exr
from neilfpp_method.data.pixels.dataset import PixelDataset
from tests.data.make_capture import make_capture

GROUND, SKY = 0.25, (0.3, 0.5, 0.9)
HORIZON = -0.05
"""z component of a direction above which it shows the sky."""


def make_sky_capture(root: Path, **options) -> Path:
    """The sphere of `make_capture` in linear values, with ground and sky as its background."""
    capture = load_capture(make_capture(root, background=GROUND, **options))
    pixels = PixelDataset(capture, capture.views)
    for i, view in enumerate(capture.views):
        batch = pixels.view(i)
        is_sky = (batch.directions[:, 2] > HORIZON) & (batch.color == GROUND).all(-1)
        image = torch.where(is_sky[:, None], torch.tensor(SKY), batch.color)
        write_exr(view.image, {"RGB": image.view(view.camera.height, view.camera.width, 3).numpy()})
    return root
