"""Every backend of the hash grid, compared with a transcription that visits one vertex at a time.

Triton's interpreter must be selected before Triton is imported, so `test_triton.py` runs this file again with
it.
"""

from __future__ import annotations

import dataclasses
import itertools
import os

import numpy as np
import pytest
import torch
from torch.autograd import gradcheck, gradgradcheck

from neilfpp_method.errors import UserError
from neilfpp_method.kernels import encode, grid_spec

# Resolutions 2, 4, 9: 27 and 125 vertices fit into 128 entries, 1000 do not.
SMALL = grid_spec(levels=3, features=2, log2_entries=7, base_resolution=2, max_resolution=9)
PRIMES = (1, 2654435761, 805459861)
BACKENDS = ("triton",) if os.environ.get("TRITON_INTERPRET") == "1" else ("reference", "cpu")


@pytest.fixture(params=BACKENDS)
def backend(request) -> str:
    return request.param


@pytest.fixture
def small(backend):
    return dataclasses.replace(SMALL, backend=backend)


def small_table(seed: int = 0) -> torch.Tensor:
    return torch.randn(SMALL.entries, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def points(count: int, seed: int = 1) -> torch.Tensor:
    return torch.rand(count, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def one_by_one(x: np.ndarray, table: np.ndarray) -> np.ndarray:
    """Müller et al. 2022, §3, for one point."""
    features, start = [], 0
    for resolution in (2, 4, 9):
        vertices = resolution + 1
        size = min(vertices**3, 128)
        cell = np.minimum(np.floor(x * resolution), resolution - 1).astype(int)
        fraction = x * resolution - cell
        total = np.zeros(2)
        for corner in itertools.product((0, 1), repeat=3):
            i, j, k = (int(c) for c in cell + corner)
            hashed = (i * PRIMES[0]) ^ (j * PRIMES[1]) ^ (k * PRIMES[2])
            row = i + vertices * (j + vertices * k) if vertices**3 <= 128 else hashed % 128
            weight = np.prod(np.where(corner, fraction, 1 - fraction))
            total += weight * table[start + row]
        features.append(total)
        start += size
    return np.concatenate(features)


def test_layout_of_the_levels():
    assert SMALL.resolutions == (2, 4, 9)
    assert SMALL.entries_per_level == (27, 125, 128)
    assert SMALL.offsets == (0, 27, 152, 280)
    assert [SMALL.is_dense(level) for level in range(3)] == [True, True, False]
    paper = grid_spec(16, 19, 4096)
    assert (paper.resolutions[0], paper.resolutions[-1], paper.width) == (16, 4096, 32)


def test_features_agree_with_the_transcription(small):
    x = torch.cat(
        (points(20), torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0], [0.5, 1.0, 0.0]], dtype=torch.float64))
    )
    expected = np.stack([one_by_one(p, small_table().numpy()) for p in x.numpy()])
    for jacobian in (False, True):
        np.testing.assert_allclose(
            encode(x, small_table(), small, jacobian).features.numpy(), expected, atol=1e-12
        )


def test_jacobian_agrees_with_differences_of_the_transcription(small):
    x, table, h = points(10), small_table().numpy(), 1e-6
    steps = h * np.eye(3)
    expected = np.stack(
        [
            np.stack([(one_by_one(p + s, table) - one_by_one(p - s, table)) / (2 * h) for s in steps], -1)
            for p in x.numpy()
        ]
    )
    jacobian = encode(x, small_table(), small, jacobian=True).jacobian
    np.testing.assert_allclose(jacobian.numpy(), expected, atol=1e-7)


def test_hash_of_a_fine_level_does_not_overflow(backend):
    """Products of vertex indices up to 4096 and the primes exceed int32. Only their low bits are used, and
    these must be correct.
    """
    spec = grid_spec(
        levels=1, features=1, log2_entries=10, base_resolution=4096, max_resolution=4096, backend=backend
    )
    table = torch.arange(1024, dtype=torch.float64)[:, None]
    vertices = torch.tensor([[4000, 3999, 3998], [17, 4096, 1]])
    expected = [(i ^ (j * PRIMES[1]) ^ (k * PRIMES[2])) % 1024 for i, j, k in vertices.tolist()]
    assert encode(vertices.double() / 4096, table, spec, jacobian=False).features[:, 0].tolist() == expected


def test_derivatives_of_features_and_jacobian(small):
    x, table = points(3).requires_grad_(), small_table().requires_grad_()

    def both(x, table):
        encoded = encode(x, table, small, jacobian=True)
        return encoded.features, encoded.jacobian

    if small.backend == "triton":  # hundreds of runs are too many for the interpreter
        assert gradcheck(both, (x, table), fast_mode=True)
    else:
        assert gradcheck(both, (x, table))
        assert gradgradcheck(lambda x, t: both(x, t)[0], (x[:1].detach().requires_grad_(), table))


def test_a_point_outside_is_clamped_to_the_cube(small):
    outside = torch.tensor([[1.4, 0.3, -0.2]], dtype=torch.float64)
    nearest = outside.clamp(0, 1)
    got, at_face = (encode(x, small_table(), small, jacobian=True) for x in (outside, nearest))
    torch.testing.assert_close(got.features, at_face.features)
    assert got.jacobian[..., [0, 2]].abs().max() == 0
    torch.testing.assert_close(got.jacobian[..., 1], at_face.jacobian[..., 1])
    assert at_face.jacobian.abs().amin() > 0


def test_repeated_runs_agree_bit_for_bit(backend):
    spec = grid_spec(levels=8, log2_entries=12, max_resolution=128, backend=backend)
    x = points(100 if backend == "triton" else 5000).float()

    def gradient():
        table = torch.linspace(-1, 1, 2 * spec.entries).view(-1, 2).requires_grad_()
        encoded = encode(x, table, spec, jacobian=True)
        (encoded.features.square().sum() + encoded.jacobian.square().sum()).backward()
        return table.grad

    assert torch.equal(gradient(), gradient())


def test_float32_and_bfloat16_follow_float64(small):
    x, table = points(200), small_table()
    exact = encode(x, table, small, jacobian=True)
    for dtype, tolerance in ((torch.float32, 1e-4), (torch.bfloat16, 0.1)):
        got = encode(x, table.to(dtype), small, jacobian=True)
        assert got.features.dtype == got.jacobian.dtype == dtype
        assert (got.features.double() - exact.features).abs().max() < tolerance
        assert (got.jacobian.double() - exact.jacobian).abs().max() < 9 * tolerance


@pytest.mark.parametrize(
    "wrong", [{"levels": 0}, {"base_resolution": 64, "max_resolution": 32}, {"log2_entries": 31}]
)
def test_an_invalid_grid_is_refused(wrong):
    with pytest.raises(UserError, match="no hash grid has"):
        grid_spec(**({"levels": 4, "log2_entries": 10, "max_resolution": 64} | wrong))
