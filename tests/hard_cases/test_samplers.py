"""Every sampler compared with the density that it reports, with a million samples each (χ²,
Šidák-corrected).
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy import stats

from neilfpp_method.fields.environment import EnvironmentLight
from neilfpp_method.shading import Sampling, sample_directions
from neilfpp_method.shading.brdf import LOBES
from tests import oracles
from tests.fields.test_map_sampling import counts, probabilities
from tests.hard_cases.known_ball import sky
from tests.shading.test_sampling import NORMALS, density, points

SAMPLES = 1_000_000
PER_POINT = {"mis": 2}
"""Directions per point, else one: those of a point share a turned lattice, and χ² wants independent ones."""
# The density of the uniform sampler is discontinuous at the horizon, which must be an edge of the cells.
CASES = [
    ("fibonacci", "ggx", "frontal"),
    *(("cosine", "ggx", view) for view in NORMALS),
    *((kind, lobe, view) for kind in ("lobe", "mis") for lobe in LOBES for view in NORMALS),
]
TESTS = len(CASES) + 1
"""Tests of this module: all of them together fail by chance once in a hundred times."""
ROUGHNESS = 0.35


@pytest.mark.hard
@pytest.mark.parametrize(("kind", "lobe", "view"), CASES)
def test_a_million_directions(kind, lobe, view):
    torch.manual_seed(11)
    count = PER_POINT.get(kind, 1)
    many = points(NORMALS[view], (0.0, 0.0, 1.0), SAMPLES // count, ROUGHNESS)
    one = tuple(t[:1] for t in many)
    result = oracles.chi2_test(
        lambda: (
            sample_directions(Sampling(kind, count, LOBES[lobe], stochastic=True), *many)
            .wi.reshape(-1, 3)
            .numpy()
        ),
        lambda wi: density(kind, LOBES[lobe], torch.from_numpy(wi)[None], *one)[0].numpy(),
        tests=TESTS,
    )
    assert result.passed, result


@pytest.mark.hard
def test_a_million_directions_of_a_map():
    """In quarters of the areas between four texels, on which the density is bilinear."""
    torch.manual_seed(12)
    light = EnvironmentLight(16, 1.0)
    light.show(torch.from_numpy(sky()).float().permute(2, 0, 1))
    normal = torch.tensor([NORMALS["oblique"]]).float()
    share = probabilities(light.technique(normal), 16, 32)
    assert share.sum() == pytest.approx(1, abs=1e-4)
    drawn = torch.cat(
        [light.technique(part).draw(1, True) for part in normal.expand(SAMPLES, 3).split(100_000)]
    )
    counted = counts(drawn, 16, 32)
    expected = share / share.sum() * counted.sum()
    rare = expected < 5
    counted = np.append(counted[~rare], counted[rare].sum())
    expected = np.append(expected[~rare], expected[rare].sum())
    p_value = stats.chisquare(counted[expected > 0], expected[expected > 0]).pvalue
    assert p_value > 1 - 0.99 ** (1 / TESTS)
