"""The environment map of the path tracer: positions of its texels, and directions in proportion to their
radiance.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch.nn.functional import normalize

from neilfpp_method.fields.environment import EnvironmentLight
from neilfpp_method.relight.sky import Sky, sky_of_run
from tests import oracles

LAYOUTS = {"ours": (True, 0.0), "common": (False, -math.pi / 2), "turned": (True, 1.1)}


def uneven(height: int = 9, width: int = 18) -> torch.Tensor:
    """A dim map with a lamp of one texel."""
    generator = torch.Generator().manual_seed(2)
    radiance = 0.2 + torch.rand(height, width, 3, generator=generator)
    radiance[2, 5] = 60.0
    return radiance


def directions(count: int = 4000) -> torch.Tensor:
    return normalize(torch.randn(count, 3, generator=torch.Generator().manual_seed(1)), dim=-1)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_directions_have_the_reported_density(layout):
    rows_at_poles, start = LAYOUTS[layout]
    sky = Sky(uneven(), rows_at_poles, start)
    u = torch.rand(200_000, 2, generator=torch.Generator().manual_seed(0))
    result = oracles.chi2_test(
        lambda: sky.sample(u).wi.numpy(),
        lambda wi: sky.pdf(torch.from_numpy(wi).float()).double().numpy(),
        tests=len(LAYOUTS),
    )
    # The oracle's cells cut through texels, on each of which the density is constant.
    assert result.total == pytest.approx(1, abs=0.01)
    wi = directions(400_000)
    assert sky.pdf(wi).double().mean().item() * 4 * math.pi == pytest.approx(1, abs=0.02)
    drawn = sky.sample(u)
    assert torch.equal(drawn.pdf, sky.pdf(drawn.wi))
    # Importance sampling of another function than the radiance: ∫ (1 + z) L dw by light directions and by
    # even ones.
    by_light = ((1 + drawn.wi[:, 2:]) * sky.lookup(drawn.wi) / drawn.pdf[:, None]).double().mean(0)
    evenly = 4 * math.pi * ((1 + wi[:, 2:]) * sky.lookup(wi)).double().mean(0)
    assert by_light.numpy() == pytest.approx(evenly.numpy(), rel=0.03)


def test_every_direction_with_light_can_be_sampled():
    radiance = torch.zeros(8, 16, 3)
    radiance[3, 0] = 1.0
    sky = Sky(radiance, False, 0.0)
    wi = directions()
    assert (sky.pdf(wi)[sky.lookup(wi).amax(-1) > 0] > 0).all()
    assert torch.isfinite(sky.sample(torch.rand(1000, 2)).wi).all()


def test_the_own_layout_is_that_of_the_fitted_light():
    light = EnvironmentLight(8, 1.0)
    light.show(uneven(8, 16).permute(2, 0, 1))
    wi = directions()
    expected = light.radiance(wi[:1], wi[None])[0].detach().numpy()
    assert sky_of_run(light).lookup(wi).numpy() == pytest.approx(expected, rel=1e-3, abs=1e-4)


def blender_uv(wi: np.ndarray) -> np.ndarray:
    """Cycles' direction_to_equirectangular: u from the left, v from the bottom."""
    u = -np.arctan2(wi[:, 1], wi[:, 0]) / (2 * np.pi) + 0.5
    v = np.arctan2(wi[:, 2], np.hypot(wi[:, 0], wi[:, 1])) / np.pi + 0.5
    return np.stack([u, v], axis=1)


def test_the_common_layout_is_that_of_blender():
    height, width = 16, 32
    radiance = uneven(height, width)
    sky = Sky(radiance, rows_at_poles=False, start=-math.pi / 2)
    row, column = np.mgrid[:height, :width].reshape(2, -1)
    theta, azimuth = np.pi * (row + 0.5) / height, np.pi - 2 * np.pi * (column + 0.5) / width
    wi = np.stack([np.sin(theta) * np.cos(azimuth), np.sin(theta) * np.sin(azimuth), np.cos(theta)], axis=1)
    place = blender_uv(wi)
    np.testing.assert_allclose(place[:, 0], (column + 0.5) / width, atol=1e-9)
    np.testing.assert_allclose(place[:, 1], 1 - (row + 0.5) / height, atol=1e-9)
    seen = sky.lookup(torch.from_numpy(wi).float())
    np.testing.assert_allclose(seen.numpy(), radiance.reshape(-1, 3).numpy(), rtol=2e-3, atol=1e-3)


def test_the_mass_of_a_texel_is_that_of_its_bilinear_radiance():
    """The lamp of one texel extends over nine; the probability of each is in proportion to its radiance."""
    radiance = torch.zeros(32, 64, 3)
    radiance[16, 20] = 1.0
    sky = Sky(radiance, False, 0.0)
    drawn = sky.sample(torch.rand(200_000, 2, generator=torch.Generator().manual_seed(0)))
    ratio = sky.lookup(drawn.wi)[:, 0] / drawn.pdf
    # Bilinear within a texel is no constant: the weight varies about its mean, 4/3 of an even cell at most
    # nine-fold.
    assert ratio.mean().item() == pytest.approx(math.pi / 32 * 2 * math.pi / 64, rel=0.02)
