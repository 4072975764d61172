"""The path tracer against brute force and against itself: means that agree within their standard errors.

The scene is a floor and two walls under an environment map with a window. Independent renders of 16 samples a
pixel, each with its own seed, estimate the radiance of a few pixels; the spread of the renders gives the
standard error of their mean. They are compared with `brute_force`, which is apart from the package, and with
renders of 32,000 samples a pixel in all. Differences are measured in standard errors (z). The bound is
Šidák's: a correct path tracer exceeds it with one seed in a thousand.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import torch
from scipy import stats

from neilfpp_method.relight import path_tracer
from neilfpp_method.relight.path_tracer import DIMENSIONS, Scene, trace_paths
from neilfpp_method.relight.sequence import SobolSequence
from neilfpp_method.relight.sky import Sky
from neilfpp_method.relight.surface import Surface
from neilfpp_method.shading import LOBES
from neilfpp_method.structures import Material, RayBatch
from tests.hard_cases.brute_force import Estimate, Squares, trace
from tests.hard_cases.known_ball import radiance_from, sky

RENDERS, SAMPLES = 64, 16
"""Independent renders, and samples a pixel of each."""
LONG_RENDERS, LONG_SAMPLES = 8, 4000
PATHS = 64_000
"""Paths a pixel of the brute force."""
BOUNCES = 4
"""Largest number of surfaces of a path."""
SIGNIFICANCE = 1e-3
TARGETS = np.array([[0.5, 0.2, 0.0], [0.2, 0.6, 0.0], [0.0, 0.5, 0.3], [0.0, 0.2, 0.15], [0.4, 0.0, 0.4]])
"""Points of the walls that the pixels show."""
EYE = np.array([1.4, 1.1, 1.2])


def corner(lobe: str) -> Squares:
    """A floor z = 0 and two walls x = 0 and y = 0, of edge 1: glossy metal, satin paint and dull paint."""
    x, y, z = np.eye(3)
    return Squares(
        corner=np.zeros((3, 3)),
        first=np.stack((x, y, z)),
        second=np.stack((y, z, x)),
        base_color=np.array([[0.9, 0.7, 0.4], [0.8, 0.8, 0.8], [0.2, 0.5, 0.7]]),
        roughness=np.array([[0.3], [0.4], [0.8]]),
        metallic=np.array([[1.0], [0.0], [0.2]]),
        lobe=lobe,
    )


def window() -> np.ndarray:
    """The map of `known_ball` with a dimmer window, which brute force finds more evenly."""
    return sky(window=5.0)


def rays() -> tuple[np.ndarray, np.ndarray]:
    directions = TARGETS - EYE
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    return np.broadcast_to(EYE, TARGETS.shape), directions


def scene(squares: Squares) -> Scene:
    a, b, c = squares.corner, squares.corner + squares.first, squares.corner + squares.second
    triangles = np.concatenate((np.stack((a, b, b + c - a), 1), np.stack((a, b + c - a, c), 1)))
    base_color, roughness, metallic = (
        torch.from_numpy(values).float()
        for values in (squares.base_color, squares.roughness, squares.metallic)
    )

    def materials(position: torch.Tensor) -> Material:
        # The square in whose plane a point lies: its normals are z, x, y.
        square = position[:, [2, 0, 1]].abs().argmin(-1)
        return Material(base_color[square], roughness[square], metallic[square])

    return Scene(
        Surface(torch.from_numpy(triangles).float()),
        materials,
        LOBES[squares.lobe],
        Sky(torch.from_numpy(window()).float(), rows_at_poles=True, start=0.0),
    )


@cache
def reference(lobe: str) -> Estimate:
    return trace(corner(lobe), lambda wi: radiance_from(window(), wi), *rays(), PATHS, BOUNCES, seed=0)


def render(lobe: str, samples: int, seed: int) -> np.ndarray:
    """One render by the package: means (N, 3) over the samples of each pixel."""
    origins, directions = (torch.tensor(values).float() for values in rays())
    numbers = SobolSequence(BOUNCES * DIMENSIONS, seed).next(samples, len(TARGETS))
    found = trace_paths(scene(corner(lobe)), RayBatch(origins, directions)[numbers.pixel], numbers, BOUNCES)
    return found.radiance.double().view(samples, len(TARGETS), 3).mean(0).numpy()


def renders(lobe: str, count: int = RENDERS, samples: int = SAMPLES, first_seed: int = 0) -> Estimate:
    """The mean of independent renders, and its variance from their spread."""
    found = np.stack([render(lobe, samples, first_seed + k) for k in range(count)])
    return Estimate(found.mean(0), found.var(0, ddof=1) / count)


def largest_z(one: Estimate, other: Estimate) -> float:
    return float((np.abs(one.mean - other.mean) / np.sqrt(one.variance + other.variance)).max())


def bound() -> float:
    """The largest |z| of all channels of all pixels that chance exceeds with the probability `SIGNIFICANCE`.

    The standard error is known from `RENDERS` renders, so z follows Student's distribution.
    """
    each = 1 - (1 - SIGNIFICANCE) ** (1 / TARGETS.size)
    return float(stats.t.isf(each / 2, RENDERS - 1))


@pytest.mark.parametrize("lobe", LOBES)
def test_renders_agree_with_brute_force(lobe):
    found = largest_z(renders(lobe), reference(lobe))
    print(f"largest z {found:.2f} of at most {bound():.2f}")  # shown by pytest -rA
    assert found < bound()


@pytest.mark.hard
@pytest.mark.parametrize("lobe", LOBES)
def test_few_samples_have_the_mean_of_many(lobe):
    many = renders(lobe, LONG_RENDERS, LONG_SAMPLES, first_seed=RENDERS)
    found = largest_z(renders(lobe), many)
    print(f"largest z {found:.2f} of at most {bound():.2f}")
    assert found < bound()


def always_one(own, other):
    return torch.ones_like(own)


FROM_SKY = path_tracer._from_sky


def unweighted_sky(*of_vertices):
    """Light sampling without the weight of the power heuristic; BRDF sampling keeps its own."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(path_tracer, "power_heuristic", always_one)
        return FROM_SKY(*of_vertices)


def pdf_of_the_cosine(at, wi, lobe):
    return SCATTERING_PDF(at, wi, None) / (1 - at.share)


SCATTERING_PDF = path_tracer.scattering_pdf
FAULTS = {
    "neither technique is weighted": ("power_heuristic", always_one),
    "light sampling is not weighted": ("_from_sky", unweighted_sky),
    "paths find no light by the BRDF": ("_from_hit_lights", lambda scene, origins, *_: 0 * origins),
    "the lobe is missing in the density of a path": ("scattering_pdf", pdf_of_the_cosine),
    "the rays of a vertex start below the surface": ("OFFSET", -1e-4),
}
"""What is planted, by the name of the module's part that it replaces."""


@pytest.mark.hard
@pytest.mark.parametrize("name", FAULTS)
def test_planted_faults_are_noticed(name, monkeypatch):
    monkeypatch.setattr(path_tracer, *FAULTS[name])
    assert largest_z(renders("ggx"), reference("ggx")) > 2 * bound()
