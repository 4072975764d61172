"""A short host, correct and with defects, for tests of code that takes a host."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace

import torch
from torch import nn
from torch.nn.functional import normalize

from neilfpp_method.structures import RayBatch, SurfaceHits


def ball_rays(count: int = 200, spread: float = 0.3, seed: int = 0) -> RayBatch:
    """Rays from all sides to points close to the origin; with the default spread all of them hit the ball."""
    generator = torch.Generator().manual_seed(seed)
    origins = 3.0 * normalize(torch.randn(count, 3, generator=generator), dim=-1)
    targets = spread * (2.0 * torch.rand(count, 3, generator=generator) - 1.0)
    return RayBatch(origins, normalize(targets - origins, dim=-1))


class Ball(nn.Module):
    """A function from rays to colour, hit position and normal of a ball with a learned radius and learned
    colours.
    """

    def __init__(self) -> None:
        super().__init__()
        self.radius = nn.Parameter(torch.tensor(0.6))
        self.paint = nn.Sequential(nn.Linear(3, 16), nn.Softplus(), nn.Linear(16, 3), nn.Softplus())

    def forward(self, origins, directions):
        middle = -(origins * directions).sum(-1, keepdim=True)
        half_chord = self.radius**2 + middle**2 - origins.square().sum(-1, keepdim=True)
        hit = (half_chord > 1e-4) & (middle > 0.0)
        position = origins + (middle - half_chord.clamp_min(1e-4).sqrt()) * directions
        return (
            torch.where(hit, self.paint(position), 0.0),
            position,
            torch.where(hit, normalize(position, dim=-1), 0.0),
        )


class BallHost(Ball):
    """The ball behind the host contract; `spoil` names the outputs that are replaced, with their
    replacements.
    """

    def __init__(self, spoil: Callable[[RayBatch, dict], dict] = lambda rays, outputs: {}) -> None:
        super().__init__()
        self.spoil = spoil

    def render(self, rays: RayBatch) -> SurfaceHits | SimpleNamespace:
        color, position, normal = self(rays.origins, rays.directions)
        hit = normal.detach().norm(dim=-1)
        outputs = {
            "color": color,
            "position": position,
            "normal": normal,
            "opacity": hit,
            "concentration": hit,
        }
        outputs |= self.spoil(rays, outputs)
        try:
            return SurfaceHits(**outputs)
        except TypeError:  # in tests the structure itself looks at shapes; in somebody's loop nothing does
            return SimpleNamespace(**outputs)
