"""Masks painted over a view, on a scene whose every point is known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from neilfpp_method.data.cameras.projection import camera_rays
from neilfpp_method.data.capture import Capture, load_capture
from neilfpp_method.data.files.images import write_png
from neilfpp_method.errors import UserError
from neilfpp_method.relight import stencil
from neilfpp_method.relight.stencil import masked_limit, read_stencils
from neilfpp_method.relight.surface import Surface
from tests.data.make_capture import RADIUS, SCALE, make_capture
from tests.relight.test_path_tracer import ball
from tests.scenes import meet_ball

IN_SCENE = RADIUS / SCALE


@pytest.fixture(scope="module")
def capture(tmp_path_factory) -> Capture:
    return load_capture(make_capture(tmp_path_factory.mktemp("capture") / "ball", size=(48, 36)))


@pytest.fixture(scope="module")
def surface() -> Surface:
    whole = ball(subdivisions=4)
    return Surface(whole.triangles * IN_SCENE / 0.6)


def mask(folder: Path, name: str, pixels: np.ndarray) -> Path:
    path = folder / f"{name}.png"
    write_png(path, (255 * pixels).astype(np.uint8))
    return path


def seen_points(capture: Capture, name: str) -> tuple[torch.Tensor, torch.Tensor]:
    """Hits of the rays of a view on the ball, (N, 3), and the indices of their pixels, (N,)."""
    camera = capture.normalization.camera(next(view.camera for view in capture.views if view.name == name))
    rays = camera_rays(camera)
    position, hit = meet_ball(rays, IN_SCENE)
    rows = torch.nonzero(hit)[:, 0]
    return position[rows], rows


@pytest.mark.parametrize("enlarged", [1, 2])
def test_points_behind_white_pixels_are_covered(capture, surface, tmp_path, enlarged):
    """At the centre of each pixel that shows the ball, except near its outline."""
    white = np.zeros((36, 48, 1))
    white[:, 24:] = 1.0
    big = white.repeat(enlarged, 0).repeat(enlarged, 1)
    limit = masked_limit(read_stencils([mask(tmp_path, "001", big)], capture), surface)
    x, pixel = seen_points(capture, "001")
    rim = (pixel.view(-1, 1) == pixel.view(1, -1) + 1).any(1) & (
        pixel.view(-1, 1) == pixel.view(1, -1) - 1
    ).any(1)
    covered = limit(x)[:, 0]
    assert rim.sum() > 50
    assert (covered == (pixel % 48 >= 24))[rim].all()


def test_the_far_side_is_not_covered(capture, surface, tmp_path):
    limit = masked_limit(read_stencils([mask(tmp_path, "001", np.ones((36, 48, 1)))], capture), surface)
    x, _ = seen_points(capture, "001")
    assert limit(x).float().mean() > 0.95
    assert not limit(-x).any()


def test_masks_of_two_views_are_combined(capture, surface, tmp_path):
    every = np.ones((36, 48, 1))
    names = ("001", "004")
    paths = [mask(tmp_path, name, every) for name in names]
    one, other = (masked_limit(read_stencils([path], capture), surface) for path in paths)
    both = masked_limit(read_stencils(paths, capture), surface)
    x = torch.cat([seen_points(capture, name)[0] for name in names])
    assert (both(x) == one(x) | other(x)).all()
    assert (one(x) != other(x)).any()


def test_transparent_pixels_do_not_count(capture, surface, tmp_path):
    layer = np.ones((36, 48, 4))
    layer[:, :24, 3] = 0.0
    limit = masked_limit(read_stencils([mask(tmp_path, "001", layer)], capture), surface)
    x, pixel = seen_points(capture, "001")
    assert not limit(x[pixel % 48 < 24]).any()
    assert limit(x[pixel % 48 >= 24]).any()


@pytest.mark.parametrize(
    ("name", "pixels", "words"),
    [
        ("nobody", np.ones((36, 48, 1)), "no view 'nobody'; name the file as the view"),
        ("001", np.ones((48, 48, 1)), "48×48 pixels, but the view has 48×36"),
        ("001", np.zeros((36, 48, 1)), "no pixel of the mask is white"),
    ],
)
def test_invalid_masks_are_refused(capture, tmp_path, name, pixels, words):
    with pytest.raises(UserError, match=words):
        read_stencils([mask(tmp_path, name, pixels)], capture)


def test_a_mask_that_is_too_large_is_refused(capture, tmp_path, monkeypatch):
    monkeypatch.setattr(stencil, "MAX_SIDE", 40)
    with pytest.raises(UserError, match="the mask has 48×36 pixels; reduce it to at most 40"):
        read_stencils([mask(tmp_path, "001", np.ones((36, 48, 1)))], capture)
