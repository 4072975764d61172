"""Frames are orthonormal and right-handed, normalisation is safe."""

from __future__ import annotations

import pytest
import torch

from neilfpp_method.shading.frame import dot, local_frame, safe_normalize

NORMALS = torch.tensor(
    [
        [0.0, 0.0, 1.0],
        [0.0, 0.0, -1.0],
        [1.0, 0.0, 0.0],
        [0.6, 0.0, -0.8],
        [0.0, -0.6, 0.8],
        [1e-4, 2e-4, -1.0],
        [-1e-6, 1e-7, -1.0],
    ],
    dtype=torch.float64,
)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 1e-6)])
def test_frame_is_orthonormal_and_right_handed(dtype, tolerance):
    n = torch.cat((NORMALS, torch.randn(1000, 3, dtype=torch.float64)))
    n = (n / n.norm(dim=-1, keepdim=True)).to(dtype)
    frame = local_frame(n)
    assert (frame @ frame.mT - torch.eye(3, dtype=dtype)).abs().max() < tolerance
    assert (torch.linalg.cross(frame[:, 0], frame[:, 1]) - n).abs().max() < tolerance
    assert torch.equal(frame[:, 2], n)


def test_frame_is_continuous_across_the_equator():
    above, below = (torch.tensor([[0.8, 0.6, z]], dtype=torch.float64) for z in (1e-9, -1e-9))
    assert (local_frame(above) - local_frame(below)).abs().max() < 1e-8


def test_frame_of_z_is_the_identity():
    assert torch.equal(local_frame(torch.tensor([[0.0, 0.0, 1.0]]))[0], torch.eye(3))


def test_safe_normalize():
    v = torch.tensor([[3.0, 0.0, 4.0], [0.0, 0.0, 0.0], [0.0, 1e-9, 0.0]], requires_grad=True)
    unit = safe_normalize(v)
    unit.sum().backward()
    assert unit.detach().allclose(torch.tensor([[0.6, 0.0, 0.8], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]))
    assert v.grad[1:].eq(0).all()
    # d(Σ v/|v|)/dv = 1/|v| − v Σv/|v|³ = 1/5 − (3, 0, 4) · 7/125
    assert v.grad[0].allclose(torch.tensor([0.2 - 21 / 125, 0.2, 0.2 - 28 / 125]))


def test_safe_normalize_keeps_the_dtype():
    assert safe_normalize(torch.ones(2, 3, dtype=torch.bfloat16)).dtype == torch.bfloat16


def test_dot_is_exact_under_autocast():
    a, b = torch.randn(5, 7, 3), torch.randn(5, 3)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        product = dot(a, b)
    assert product.allclose((a * b[:, None]).sum(-1), atol=1e-6)
