"""Surface points under known light, for tests."""

from __future__ import annotations

import torch
from torch.nn.functional import normalize

from neilfpp_method.structures import Material, Observed, SceneLight


def half_room(x: torch.Tensor, wi: torch.Tensor) -> SceneLight:
    """A scene with a wall at distance 2 and radiance 0.7 in all downward directions, and nothing above."""
    below = wi[..., 2] < 0
    distance = torch.where(below, 2.0, torch.inf)
    return SceneLight(below, below[..., None] * torch.full_like(wi, 0.7), distance)


def points(count: int, seed: int = 0) -> Observed:
    """Points near the origin with normals in all directions, each viewed from within 60° of its normal."""
    generator = torch.Generator().manual_seed(seed)
    normal = normalize(torch.randn(count, 3, generator=generator), dim=-1)
    wo = normalize(normal + 0.8 * normalize(torch.randn(count, 3, generator=generator), dim=-1), dim=-1)
    return Observed(0.1 * normal, normal, wo, torch.zeros(count, 3))


def material(count: int, seed: int = 1) -> Material:
    """A different material at every point."""
    generator = torch.Generator().manual_seed(seed)
    base_color = 0.2 + 0.6 * torch.rand(count, 3, generator=generator)
    roughness = 0.3 + 0.5 * torch.rand(count, 1, generator=generator)
    metallic = torch.rand(count, 1, generator=generator).round()
    return Material(base_color, roughness, metallic)


def patches(position: torch.Tensor) -> Material:
    """Roughness and metallic of `material`, and a base colour for each octant around the centre of the
    points.
    """
    speckled = material(len(position))
    octant = ((position > position.mean(0)) * torch.tensor([1, 2, 4])).sum(-1)
    return Material(speckled.base_color[octant], speckled.roughness, speckled.metallic)


def looks(count: int, below: float = 1.0) -> torch.Tensor:
    """Viewing directions of cameras; none of them above a given height."""
    wi = normalize(torch.randn(8 * count, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    return wi[wi[:, 2] <= below][:count]
