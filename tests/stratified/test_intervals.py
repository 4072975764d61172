"""Stratified samples: one in each part, with the distribution that was asked for."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.stats import chisquare, kstest

from neilfpp_method.stratified import intervals
from neilfpp_method.stratified.intervals import inverse_cdf_samples, strata, uniform_samples

F64 = torch.float64


def test_each_stratum_has_one_number():
    torch.manual_seed(0)
    like = torch.zeros(4000, 1, dtype=F64)
    assert strata(like[:2], 4, False).tolist() == [[0.125, 0.375, 0.625, 0.875]] * 2
    scaled = 4 * strata(like, 4, True)
    assert (scaled.floor() == torch.arange(4)).all()
    assert kstest((scaled - scaled.floor()).flatten().numpy(), "uniform").pvalue > 1e-3


def test_uniform_samples_are_both_ends_and_the_centers_of_equal_parts():
    samples = uniform_samples(torch.tensor([0.0, 1.0]), torch.tensor([4.0, 1.0]), 6, False)
    assert samples.tolist() == [[0.0, 0.5, 1.5, 2.5, 3.5, 4.0], [1.0] * 6]


def test_random_uniform_samples_have_one_in_each_part():
    torch.manual_seed(0)
    samples = uniform_samples(torch.full((4000,), 2.0), torch.full((4000,), 6.0), 6, True)[:, 1:-1]
    assert (samples.floor() == torch.tensor([2.0, 3.0, 4.0, 5.0])).all()
    assert kstest((samples - samples.floor()).flatten().numpy(), "uniform").pvalue > 1e-3


def test_inverse_cdf_by_hand():
    edges, mass = torch.tensor([[0.0, 1.0, 3.0]]), torch.tensor([[2.0, 2.0]])
    # u = 1/8, 3/8 | 5/8, 7/8: half of the mass lies in [0, 1], half in [1, 3].
    assert inverse_cdf_samples(edges, mass, 4, False).tolist() == [[0.25, 0.75, 1.5, 2.5]]


def test_inverse_cdf_draws_from_a_piecewise_constant_density():
    torch.manual_seed(0)
    edges = torch.tensor([0.0, 0.5, 0.6, 1.5, 1.5, 2.0, 4.0], dtype=F64)
    mass = torch.tensor([0.1, 0.4, 0.0, 0.0, 0.3, 0.2], dtype=F64)
    draws = 20_000
    # One sample per row: independent, as the χ² test requires.
    samples = inverse_cdf_samples(edges.expand(draws, 7), mass.expand(draws, 6), 1, True)[:, 0].numpy()
    counts = np.histogram(samples, edges.numpy()[[0, 1, 2, 4, 5, 6]])[0]
    assert counts[2] == 0  # the flat part of the CDF
    assert chisquare(counts[[0, 1, 3, 4]], draws * np.array([0.1, 0.4, 0.3, 0.2])).pvalue > 1e-3
    within = samples[(samples > 2.0)] / 2.0 - 1.0
    assert kstest(within, "uniform").pvalue > 1e-3


@pytest.mark.parametrize("stochastic", [False, True])
def test_inverse_cdf_gives_one_sample_to_each_share_and_none_to_flat_parts(stochastic):
    mass = torch.tensor([[0.0, 1.0, 0.0, 0.0, 3.0, 0.0]])
    samples = inverse_cdf_samples(torch.arange(7.0)[None], mass, 64, stochastic)
    assert ((samples >= 1.0) & (samples <= 2.0)).sum() == 16
    assert ((samples >= 4.0) & (samples <= 5.0)).sum() == 48
    assert (samples.diff(dim=-1) >= 0.0).all()


def test_inverse_cdf_without_mass_is_uniform_in_length():
    samples = inverse_cdf_samples(torch.tensor([[0.0, 3.0, 4.0]]), torch.zeros(1, 2), 4, False)
    torch.testing.assert_close(samples, torch.tensor([[0.5, 1.5, 2.5, 3.5]]))


@pytest.mark.parametrize(("u", "mass", "where"), [(0.0, [0.0, 1.0, 1.0], 1.0), (1.0, [1.0, 1.0, 0.0], 2.0)])
def test_inverse_cdf_at_its_ends_stays_in_bins_with_mass(monkeypatch, u, mass, where):
    monkeypatch.setattr(intervals, "strata", lambda like, count, stochastic: torch.full((1, count), u))
    samples = inverse_cdf_samples(torch.arange(4.0)[None], torch.tensor([mass]), 1, True)
    assert samples.item() == pytest.approx(where, abs=1e-6)
