"""Backends compared with the reference: gradients, unusual inputs, threads, and the choice of the backend."""

from __future__ import annotations

import dataclasses
import multiprocessing
import os
import subprocess
import sys
import threading
import warnings
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neilfpp_method import kernels
from neilfpp_method.errors import UserError
from neilfpp_method.kernels import encode, function, grid_spec
from neilfpp_method.kernels.threads import for_each, shares

INTERPRETED = os.environ.get("TRITON_INTERPRET") == "1"
BACKEND = "triton" if INTERPRETED else "cpu"
# Dense and hashed levels, an odd number of features, a finest level that is no power of two.
SPEC = grid_spec(levels=4, features=3, log2_entries=8, base_resolution=3, max_resolution=50, backend=BACKEND)


def table(seed: int = 0, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(SPEC.entries, SPEC.features, dtype=dtype, generator=generator)


def scattered(count: int, seed: int = 1) -> torch.Tensor:
    """Points in the cube and slightly outside of it."""
    return (
        1.2 * torch.rand(count, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)) - 0.1
    )


def everything(
    x: torch.Tensor, table: torch.Tensor, backend: str, jacobian: bool = True
) -> list[torch.Tensor]:
    """Features, Jacobian, and the gradients of a loss that weights both at random."""
    x, table = x.clone().requires_grad_(), table.clone().requires_grad_()
    encoded = encode(x, table, dataclasses.replace(SPEC, backend=backend), jacobian)
    outputs = [encoded.features, encoded.jacobian] if jacobian else [encoded.features]
    generator = torch.Generator().manual_seed(2)
    weights = [torch.randn(o.shape, dtype=torch.float64, generator=generator).to(o) for o in outputs]
    torch.autograd.backward(outputs, weights)
    return [*(o.detach() for o in outputs), x.grad, table.grad]


def assert_agree(x: torch.Tensor, jacobian: bool = True) -> None:
    for got, expected in zip(
        everything(x, table(), BACKEND, jacobian), everything(x, table(), "reference", jacobian), strict=True
    ):
        torch.testing.assert_close(got, expected, rtol=1e-10, atol=1e-10)


# ------------------------------------------------------------------------------------- equal to the reference


@pytest.mark.parametrize("count", [0, 1, 128, 130])
@pytest.mark.parametrize("jacobian", [False, True])
def test_any_number_of_points(count, jacobian):
    assert_agree(scattered(count), jacobian)


def test_points_on_faces_edges_corners_and_vertices():
    ends = torch.tensor([0.0, 1.0 / 3.0, 1.0, -0.0], dtype=torch.float64)
    assert_agree(torch.cartesian_prod(ends, ends, ends))


def test_points_far_outside():
    far = torch.tensor(
        [[1e30, 0.5, 0.5], [-1e30, 2.0, -7.0], [torch.inf, 0.2, -torch.inf]], dtype=torch.float64
    )
    got, expected = everything(far, table(), BACKEND), everything(far, table(), "reference")
    torch.testing.assert_close(got, expected, equal_nan=True)


def test_gradients_of_many_points_at_one_position_add_up():
    assert_agree(scattered(1).expand(200, 3))


@settings(max_examples=3 if INTERPRETED else 30, deadline=None)
@given(
    levels=st.integers(1, 5),
    features=st.integers(1, 5),
    log2_entries=st.integers(1, 12),
    base=st.integers(1, 8),
    growth=st.integers(1, 600),
    seed=st.integers(0, 9),
)
def test_every_grid_agrees_with_the_reference(levels, features, log2_entries, base, growth, seed):
    spec = grid_spec(levels, log2_entries, base * growth, base, features, BACKEND)
    x, generator = scattered(40, seed), torch.Generator().manual_seed(seed)
    rows = torch.randn(spec.entries, features, dtype=torch.float64, generator=generator)
    got, expected = (
        encode(x, rows, dataclasses.replace(spec, backend=name), True) for name in (BACKEND, "reference")
    )
    torch.testing.assert_close(got.features, expected.features, atol=1e-10, rtol=1e-10)
    torch.testing.assert_close(got.jacobian, expected.jacobian, atol=1e-8, rtol=1e-8)


def test_float32_gradients():
    x = scattered(200).float()
    for got, expected in zip(
        everything(x, table(dtype=torch.float32), BACKEND),
        everything(x, table(dtype=torch.float32), "reference"),
        strict=True,
    ):
        torch.testing.assert_close(got, expected, rtol=1e-4, atol=1e-3 * expected.abs().max().item())


def test_nan_stays_nan_and_affects_no_other_point():
    x = scattered(20)
    x[7, 1] = torch.nan
    encoded = encode(x, table(), SPEC, True)
    clean = encode(scattered(20), table(), SPEC, True)
    assert encoded.features[7].isnan().all()
    others = torch.arange(20) != 7
    assert torch.equal(encoded.features[others], clean.features[others])
    assert torch.equal(encoded.jacobian[others], clean.jacobian[others])


def test_inputs_in_any_memory_order():
    x, rows = scattered(3, 5).repeat(1, 2)[:, ::2], table()
    strided = torch.empty(SPEC.features, SPEC.entries, dtype=torch.float64).t().copy_(rows)
    got, expected = everything(x, strided, BACKEND), everything(x.contiguous(), rows, "reference")
    torch.testing.assert_close(got, expected, rtol=1e-10, atol=1e-10)


def test_only_inputs_that_require_it_get_a_gradient():
    x, rows = scattered(5), table().requires_grad_()
    encode(x, rows, SPEC, True).jacobian.square().sum().backward()  # the loss does not depend on the features
    expected = table().requires_grad_()
    encode(
        x, expected, dataclasses.replace(SPEC, backend="reference"), True
    ).jacobian.square().sum().backward()
    torch.testing.assert_close(rows.grad, expected.grad, rtol=1e-9, atol=1e-9)
    assert x.grad is None


# ---------------------------------------------------------------------------------------------- higher orders


def test_the_second_derivative_of_a_second_derivative():
    """The analytic Hessian of a field and a loss on it, as in `SdfField`."""

    def loss_gradient(backend):
        x, rows = scattered(4).requires_grad_(), table().requires_grad_()
        encoded = encode(x, rows, dataclasses.replace(SPEC, backend=backend), True)
        slope = (encoded.features.square()[..., None] * encoded.jacobian).sum((0, 1))
        hessian = torch.stack([torch.autograd.grad(s, x, create_graph=True)[0] for s in slope])
        return torch.autograd.grad(hessian.square().sum(), (rows, x))

    for got, expected in zip(loss_gradient(BACKEND), loss_gradient("reference"), strict=True):
        torch.testing.assert_close(got, expected, rtol=1e-8, atol=1e-8 * expected.abs().max().item())


# ---------------------------------------------------------------------------------------------------- threads


@pytest.fixture
def threads():
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@pytest.mark.skipif(INTERPRETED, reason="the interpreter knows no threads")
def test_the_result_does_not_depend_on_the_number_of_threads(threads):
    x, rows = scattered(20_000), table()
    threads(1)
    one = everything(x, rows, BACKEND)
    threads(3)
    three = everything(x, rows, BACKEND)
    assert all(torch.equal(a, b) for a, b in zip(one, three, strict=True))


@pytest.mark.skipif(INTERPRETED, reason="the interpreter knows no threads")
def test_concurrent_calls(threads):
    threads(2)
    x, rows, found = scattered(5000), table(), {}
    expected = everything(x, rows, BACKEND)
    callers = [
        threading.Thread(target=lambda n=n: found.update({n: everything(x, rows, BACKEND)})) for n in range(3)
    ]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join()
    assert len(found) == 3
    assert all(torch.equal(a, b) for values in found.values() for a, b in zip(values, expected, strict=True))


def test_shares_cover_everything_once(threads):
    threads(3)
    for count, least in ((10, 1), (10, 4), (2, 1), (0, 5)):
        runs = shares(count, least)
        assert [n for start, stop in runs for n in range(start, stop)] == list(range(count))
        assert len(runs) == max(1, min(3, count // least))


def test_an_error_in_a_thread_is_raised(threads):
    def work(start, stop):
        if start == 2:
            raise ValueError("in the second run")

    with pytest.raises(ValueError, match="second run"):
        for_each(work, [(0, 2), (2, 4)])


def mark(queue) -> None:
    done = []
    for_each(lambda start, stop: done.append(start), [(0, 1), (1, 2), (2, 3)])
    queue.put(sorted(done))


@pytest.mark.skipif(sys.platform != "linux", reason="no fork")
def test_threads_after_a_fork():
    for_each(lambda start, stop: None, [(0, 1), (1, 2), (2, 3)])  # the parent process has started its threads
    context = multiprocessing.get_context("fork")
    queue = context.Queue()
    child = context.Process(target=mark, args=(queue,))
    with warnings.catch_warnings():
        warnings.simplefilter(
            "ignore", DeprecationWarning
        )  # later Pythons advise against what this test is about
        child.start()
    assert queue.get(timeout=30) == [0, 1, 2]
    child.join()


# ------------------------------------------------------------------------------------------------- the choice


@pytest.fixture(autouse=True)
def _fresh_choice():
    kernels._kernels.cache_clear()
    yield
    kernels._kernels.cache_clear()


def used(monkeypatch, spec, dtype=torch.float32) -> str:
    """Which backend computes: the reference, or kernels."""
    seen = []
    original = function.encode_with
    monkeypatch.setattr(kernels, "encode_with", lambda *args: (seen.append(args[0]), original(*args))[1])
    encode(scattered(2).to(dtype), table(dtype=dtype), spec, False)
    return "kernels" if seen else "reference"


@pytest.mark.skipif(INTERPRETED, reason="about the CPU backend")
def test_a_cpu_uses_the_compiled_loops_by_default(monkeypatch):
    assert used(monkeypatch, dataclasses.replace(SPEC, backend="auto")) == "kernels"
    assert used(monkeypatch, dataclasses.replace(SPEC, backend="cpu")) == "kernels"
    assert used(monkeypatch, dataclasses.replace(SPEC, backend="reference")) == "reference"


def test_half_precision_uses_the_reference(monkeypatch):
    assert used(monkeypatch, SPEC, torch.bfloat16) == "reference"


def test_without_numba_the_reference_is_used_with_a_warning(monkeypatch):
    monkeypatch.setitem(sys.modules, "neilfpp_method.kernels.cpu", None)
    with pytest.warns(RuntimeWarning, match="slow reference"):
        assert used(monkeypatch, dataclasses.replace(SPEC, backend="auto")) == "reference"
    kernels._kernels.cache_clear()
    with pytest.raises(UserError, match="backend 'cpu'"):
        encode(scattered(2), table(), dataclasses.replace(SPEC, backend="cpu"), False)


@pytest.mark.skipif(INTERPRETED, reason="the interpreter runs on a CPU")
def test_triton_on_a_cpu_is_refused():
    pytest.importorskip("triton")
    with pytest.raises(UserError, match="'triton' does not run on cpu"):
        encode(scattered(2), table(), dataclasses.replace(SPEC, backend="triton"), False)


def test_a_table_of_another_size_is_refused():
    with pytest.raises(ValueError, match="a table of"):
        encode(scattered(2), table()[:-1], SPEC, False)


@pytest.mark.skipif(INTERPRETED or os.name != "posix", reason="about the CPU backend")
def test_loops_compile_without_a_cache_on_disk(tmp_path):
    """The locators of Numba's cache are removed, as in a read-only installation without a home folder."""
    script = """
from numba.core import caching
caching.CacheImpl._locator_classes = []
from neilfpp_method.kernels import compiled
assert compiled._corners.stats.cache_path is None
"""
    root = Path(__file__).parents[2]
    subprocess.run(
        [sys.executable, "-c", script], check=True, cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(root)}
    )
