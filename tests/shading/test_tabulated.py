"""A table of directions draws from the density it reports, keeps to its cells, and knows the horizon."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from neilfpp_method.shading.tabulated import DirectionTable, cell_directions, with_cosine
from tests import oracles

R, C = 8, 12


def uneven(points: int = 1) -> DirectionTable:
    weights = torch.rand(points, R, C, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) ** 4
    weights[:, 2] = 0  # a row without light
    weights[:, :, 5] = 0  # a column without light
    return DirectionTable(weights)


def test_chi2():
    """Cells of the table against cells of the test: 12 columns and 32, so neither hides the other's edges."""
    generator = torch.Generator().manual_seed(1)
    u, v = torch.rand(2, 1, 100_000, dtype=torch.float64, generator=generator)
    table = uneven()
    directions = table.draw(u, v)[0].numpy()
    # The quadrature of the χ² test wants a smooth density, so the table's own cells are counted here.
    row = ((1 - directions[:, 2]) * R / 2).astype(int).clip(0, R - 1)
    column = (np.arctan2(directions[:, 1], directions[:, 0]) % (2 * np.pi) / (2 * np.pi) * C).astype(int).clip(0, C - 1)
    counts = np.bincount(row * C + column, minlength=R * C)
    expected = (table.weights / table.weights.sum()).numpy().reshape(-1) * len(directions)
    assert (counts[expected == 0] == 0).all()
    kept = expected > 0
    statistic = ((counts - expected)[kept] ** 2 / expected[kept]).sum()
    assert oracles.stats.chi2.sf(statistic, kept.sum() - 1) > 0.01


def test_directions_are_even_within_a_cell():
    """One cell alone: its z and its azimuth fill their ranges evenly, and the density is 1 / its solid angle."""
    weights = torch.zeros(1, R, C, dtype=torch.float64)
    weights[0, 3, 7] = 5.0
    table = DirectionTable(weights)
    u = (torch.arange(1000, dtype=torch.float64)[None] + 0.5) / 1000
    wi = table.draw(u, u)
    z = wi[0, :, 2].flip(0)
    turn = torch.atan2(wi[0, :, 1], wi[0, :, 0]) % (2 * math.pi) / (2 * math.pi)
    middles = (torch.arange(1000, dtype=torch.float64) + 0.5) / 1000
    assert z.allclose(1 - 2 * 4 / R + 2 / R * middles)
    assert turn.allclose((7 + middles) / C)
    assert table.pdf(wi).allclose(torch.full_like(u, R * C / (4 * math.pi)))


def test_the_density_is_normalised_for_every_point():
    table, dense = uneven(3), cell_directions(200, 300, torch.zeros(1, dtype=torch.float64)).reshape(1, -1, 3)
    mean = table.pdf(dense.expand(3, -1, -1)).mean(1)
    assert mean.allclose(torch.full_like(mean, 1 / (4 * math.pi)), rtol=1e-2)


def test_one_table_serves_all_points():
    table = uneven()
    u, v = torch.rand(2, 4, 9, dtype=torch.float64)
    many = DirectionTable(table.weights.expand(4, -1, -1))
    assert torch.equal(table.draw(u, v), many.draw(u, v))
    assert torch.equal(table.pdf(table.draw(u, v)), many.pdf(many.draw(u, v)))


def test_a_dark_table_is_even():
    table = DirectionTable(torch.zeros(2, R, C))
    wi = table.draw(torch.rand(2, 5), torch.rand(2, 5))
    assert table.pdf(wi).allclose(torch.full((2, 5), 1 / (4 * math.pi)))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("edge", [0.0, 1.0])
def test_the_ends_of_the_unit_square_are_directions_with_a_density(dtype, edge):
    table = DirectionTable(uneven().weights.to(dtype))
    wi = table.draw(*torch.full((2, 1, 1), edge, dtype=dtype))
    assert wi.isfinite().all()
    assert wi.norm(dim=-1).item() == pytest.approx(1, abs=1e-6)


def test_cosine_leaves_no_cell_out_that_sees_the_surface():
    """Wherever n·wi > 0 the density is above 0, and cells well below the horizon have none."""
    n = torch.nn.functional.normalize(torch.randn(20, 3, generator=torch.Generator().manual_seed(2)), dim=-1)
    table = with_cosine(torch.ones(1, 16, 16), n)
    wi = torch.nn.functional.normalize(torch.randn(20, 2000, 3, generator=torch.Generator().manual_seed(3)), dim=-1)
    cosine = torch.einsum("nsk,nk->ns", wi, n)
    density = table.pdf(wi)
    assert (density[cosine > 0.3] > 0).all()
    assert (density[cosine < -0.5] == 0).all()
    assert (density > 0)[cosine > 0].float().mean() > 0.97
    up = with_cosine(torch.ones(1, 16, 16), torch.tensor([[0.0, 0.0, 1.0]]))
    top = up.weights[0, :, 0]
    assert (top[:8].diff() < 0).all()
