"""Attach material and light to a function that renders rays, in your own training loop.

    python examples/01_attach_to_a_callable.py

The lines marked 1, 2 and 3 are all that the add-on needs.
"""

from __future__ import annotations

import dataclasses

import torch
from torch import nn
from torch.nn.functional import normalize

from neilfpp_method import attach_neilf, preset
from neilfpp_method.attach import pixel_batch
from neilfpp_method.settings.presets import free_light


class Ball(nn.Module):
    """Stand-in for your model: returns color, hit position and normal; the normal of a miss is zero."""

    def __init__(self) -> None:
        super().__init__()
        self.radius = nn.Parameter(torch.tensor(0.5))
        self.paint = nn.Sequential(nn.Linear(3, 64), nn.ReLU(), nn.Linear(64, 3), nn.Softplus())

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


def photograph(count: int):
    """Random rays towards the origin, and the radiance of a red ball under a white sky along them."""
    origins = 3.0 * normalize(torch.randn(count, 3), dim=-1)
    directions = normalize(0.3 * torch.randn(count, 3) - origins, dim=-1)
    _, _, normal = Ball()(origins, directions)
    sky = 0.5 + 0.5 * normal[:, 2:]  # visible share of the sky
    return origins, directions, sky * torch.tensor([0.8, 0.2, 0.1]) * normal.norm(dim=-1, keepdim=True)


torch.manual_seed(0)
host = Ball()
optimizer = torch.optim.Adam(host.parameters(), lr=5e-3)
settings = free_light(preset("fast"))
settings = dataclasses.replace(
    settings, train=dataclasses.replace(settings.train, sdf_steps=60, joint_steps=20)
)

neilf = attach_neilf(host, settings, median_radiance=0.2)  # 1
optimizer.add_param_group({"params": neilf.parameters(), "lr": 2e-3})  # 2
for step in range(160):  # 60 steps of the host only, then 100 with material and light
    origins, directions, color = photograph(256)
    own = (host(origins, directions)[0] - color).abs().mean()
    total = neilf.losses(pixel_batch(origins, directions, color), step)
    optimizer.zero_grad()
    (own + total.loss).backward()  # 3
    optimizer.step()
    if step % 40 == 39:
        terms = ", ".join(f"{name} {value.item():.3f}" for name, value in total.terms.items())
        print(f"step {step + 1}: own loss {own.item():.3f}; {terms or 'nothing yet'}")
print("base colour at the top:", neilf.materials(torch.tensor([[0.0, 0.0, 0.5]])).base_color)
