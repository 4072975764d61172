"""Rendered images: when they are finished, and independence from the division of the work."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from neilfpp_method.data.cameras.camera import Camera
from neilfpp_method.relight import film
from neilfpp_method.relight.film import Budget, render_picture
from neilfpp_method.relight.path_tracer import Scene
from neilfpp_method.relight.sequence import SobolSequence
from tests.relight.test_path_tracer import EVEN, ball, made_of


def camera(width: int = 12, height: int = 9) -> Camera:
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[2, 3] = 3.0
    return Camera(20.0, 20.0, width / 2, height / 2, width, height, pose)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene(ball(), made_of(0.6), None, EVEN)


def test_an_image_does_not_depend_on_the_batches(scene, monkeypatch):
    whole = render_picture(scene, camera(), Budget(8), bounces=2, seed=3)
    assert whole.samples == 8
    monkeypatch.setattr(film, "PATHS_AT_ONCE", 50)
    parts = render_picture(scene, camera(), Budget(8), bounces=2, seed=3)
    assert torch.allclose(whole.radiance, parts.radiance, atol=1e-6)
    other = render_picture(scene, camera(), Budget(8), bounces=2, seed=4)
    assert not torch.allclose(whole.radiance, other.radiance)


def test_alpha_is_the_share_of_a_pixel_that_is_covered(scene):
    size = 40
    picture = render_picture(scene, camera(size, size), Budget(64), bounces=1)
    # A ball of radius 0.6 at the distance 3: its outline has the tangent r/√(d² − r²) = 0.2041, in pixels
    # 4.08.
    assert picture.alpha.sum().item() == pytest.approx(np.pi * (20 * 0.6 / np.sqrt(9 - 0.36)) ** 2, rel=0.02)
    assert picture.alpha[size // 2, size // 2] == 1
    assert picture.alpha[0, 0] == 0
    # Under light of 1 from all directions, covered pixels have the base colour, and the others are black.
    assert torch.allclose(picture.radiance.mean(-1, keepdim=True), 0.6 * picture.alpha, atol=0.05)
    assert torch.allclose(picture.albedo, 0.6 * picture.alpha.expand(-1, -1, 3), atol=1e-5)
    assert picture.normal[size // 2, size // 2, 2] > 0.95


def test_the_time_limit_ends_an_image(scene, monkeypatch):
    ticks = iter(range(10_000))
    monkeypatch.setattr("neilfpp_method.relight.film.monotonic", lambda: float(next(ticks)))
    shares: list[float] = []
    budget = Budget(None, seconds=10.0)
    picture = render_picture(scene, camera(64, 64), budget, 1, 0, shares.append)
    assert 1 <= picture.samples < 200
    assert shares == sorted(shares)
    assert shares[-1] == pytest.approx(1, abs=0.2)
    rushed = render_picture(scene, camera(), Budget(None, seconds=1e-9), bounces=1)
    assert rushed.samples >= 1


def test_more_samples_are_more_accurate(scene):
    """The error of a quasi-random sequence decreases faster than that of random numbers, 1/√n."""
    exact = 0.6

    def error(samples: int) -> float:
        picture = render_picture(scene, camera(6, 6), Budget(samples), bounces=1)
        covered = picture.alpha[..., 0] == 1
        return (picture.radiance[covered] - exact).square().mean().sqrt().item()

    assert error(1024) < error(16) / 6


def test_numbers_are_evenly_spread_and_differ_between_pixels():
    numbers = SobolSequence(4, seed=1).next(256, 5)
    u = numbers.at(torch.arange(5 * 256), 1, 2)
    assert u.min() >= 0
    assert u.max() < 1
    for pixel in range(5):
        for dimension in range(2):
            strata = (u[numbers.pixel == pixel, dimension] * 16).long().bincount(minlength=16)
            assert (strata - 16).abs().max() <= 1
    first = u[numbers.sample == 0, 0]
    assert len(first.unique()) == 5
    # Generated in blocks, the sequence is the same.
    halves = SobolSequence(4, seed=1)
    pair = [halves.next(128, 5) for _ in range(2)]
    again = torch.cat([part.at(torch.arange(5 * 128), 1, 2) for part in pair])
    assert torch.equal(again, u)


def test_shifts_are_spread_evenly():
    numbers = SobolSequence(1, seed=9).next(1, 100_000)
    u = numbers.at(torch.arange(100_000), 0, 1)[:, 0]
    counts = (u * 50).long().bincount(minlength=50).double()
    assert ((counts - 2000).square() / 2000).sum() < 85.4  # χ² with 49 degrees of freedom, 1 in 1000
