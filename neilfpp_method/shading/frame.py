"""Vectors at a surface point: local frames, safe normalisation, cosines."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

__all__ = ["at_least_float32", "dot", "local_frame", "safe_normalize"]


def at_least_float32(tensor: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Convert half precision to float32: the 8 bits of a bfloat16 cannot represent a cosine near 1."""
    return tensor.to(torch.promote_types(tensor.dtype, torch.float32))


def dot(directions: Float[Tensor, "#N S 3"], vector: Float[Tensor, "N 3"]) -> Float[Tensor, "N S"]:
    """The inner product of each direction with the vector of its point, in at least float32.

    Directions that all points share have shape (1, S, 3). The sum is written out because it then needs no
    (N, S, 3) product, and because autocast and TF32 would round a matmul.
    """
    a, b = at_least_float32(directions), at_least_float32(vector).unsqueeze(1)
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


def safe_normalize(v: Float[Tensor, "*batch 3"], eps: float = 1e-6) -> Float[Tensor, "*batch 3"]:
    """v / |v|, or the zero vector with a zero gradient where |v| < eps. The gradient is at most 1/eps."""
    wide = at_least_float32(v)
    squared = wide.square().sum(-1, keepdim=True)
    long_enough = squared >= eps * eps
    length = torch.where(long_enough, squared, 1.0).sqrt()
    return torch.where(long_enough, wide / length, 0.0).to(v.dtype)


def local_frame(n: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3 3"]:
    """A right-handed orthonormal frame with rows tangent, bitangent, normal; n must be unit.

    t = (1 − a x², −a x y, −x), b = (−a x y, 1 − a y², −y) with a = 1/(1 + z) (Frisvad 2012). It is continuous
    except at n = −z; no frame is continuous everywhere. For z < 0 the equal expression a = (1 − z)/(x² + y²)
    is used, which is accurate near −z.
    """
    x, y, z = n.unbind(-1)
    eps = torch.finfo(n.dtype).eps
    at_pole = (z < 0) & (x * x + y * y < eps * eps)
    x, y = torch.where(at_pole, eps, x), torch.where(at_pole, 0.0, y)
    a = torch.where(z < 0, (1 - z) / (x * x + y * y).clamp_min(eps * eps), 1 / (1 + z.clamp_min(0)))
    cross = -a * x * y
    tangent = torch.stack((1 - a * x * x, cross, -x), -1)
    bitangent = torch.stack((cross, 1 - a * y * y, -y), -1)
    return torch.stack((tangent, bitangent, n), -2)
