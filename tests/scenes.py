"""Small scenes that several tests share."""

from __future__ import annotations

import dataclasses

import torch
from torch.nn.functional import normalize

from neilfpp_method.hosts.volsdf import VolSdfHost
from neilfpp_method.model import NeilfModel
from neilfpp_method.settings.facts import SceneFacts
from neilfpp_method.settings.presets import free_light, preset
from neilfpp_method.settings.types import HashGridConfig, NeilfConfig, TrainConfig
from neilfpp_method.structures import PixelBatch, RayBatch


def tiny_config(**changes) -> NeilfConfig:
    """The preset `fast`, reduced to milliseconds per step."""
    config = free_light(preset("fast"))
    small = dataclasses.replace(
        config,
        host=dataclasses.replace(
            config.host,
            sdf=dataclasses.replace(config.host.sdf, width=16, feature_width=4),
            volume=dataclasses.replace(config.host.volume, samples=20, beta_init=0.02, skip_empty=False),
        ),
        encoding=HashGridConfig(levels=3, log2_entries=10, sdf_log2_entries=10, max_resolution=32),
        radiance=dataclasses.replace(config.radiance, layers=1, width=16),
        brdf=dataclasses.replace(config.brdf, layers=1, width=16),
        light=dataclasses.replace(config.light, layers=4, width=16, rays_per_point=0.5),
        background=dataclasses.replace(config.background, samples=4),
        shading=dataclasses.replace(config.shading, train_samples=8, eval_samples=8),
        loss=dataclasses.replace(config.loss, lambertian=5e-4),  # every loss of the table counts
        train=TrainConfig(sdf_steps=4, material_steps=4, joint_steps=4, rays=48, checkpoint_every=3),
    )
    return dataclasses.replace(small, **changes)


def sphere_model(
    config: NeilfConfig | None = None, response: str = "linear", background: str = "constant"
) -> NeilfModel:
    """An untrained model: its surface is the sphere of radius 0.6 that every field starts as, β = 0.02."""
    torch.manual_seed(0)
    config = config or tiny_config()
    facts = SceneFacts(response, 0.2, 1.0 if response == "srgb" else 3.0, background)
    return NeilfModel(VolSdfHost(config, facts), config, facts)


def sphere_batch(count: int = 48, spread: float = 0.8, color: float = 0.3) -> PixelBatch:
    """Rays from z = −3 towards a square around the origin; with the default spread most hit the sphere."""
    generator = torch.Generator().manual_seed(1)
    origins = torch.tensor([[0.0, 0.0, -3.0]]).expand(count, 3)
    targets = torch.rand(count, 3, generator=generator) * 2.0 - 1.0
    targets = targets * torch.tensor([spread, spread, 0.0])
    return PixelBatch(
        origins=origins,
        directions=normalize(targets - origins, dim=-1),
        color=torch.full((count, 3), color),
        mask=torch.ones(count),
        mask_known=torch.zeros(count),
        image_gradient=torch.zeros(count),
        view=torch.zeros(count, dtype=torch.long),
    )


def meet_ball(rays: RayBatch, radius: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Positions at which rays hit a ball around the origin, (N, 3), and whether they do, 1 or 0."""
    along = -(rays.origins * rays.directions).sum(-1)
    square = along.square() - rays.origins.square().sum(-1) + radius**2
    position = rays.origins + (along - square.clamp_min(0).sqrt())[:, None] * rays.directions
    return position, ((square > 0) & (along > 0)).float()


def sphere_distance(x: torch.Tensor) -> torch.Tensor:
    """Signed distance to the sphere of radius 0.6 around the origin."""
    return x.norm(dim=-1) - 0.6


def positions(count: int = 8) -> torch.Tensor:
    """Random points of the cube [−1, 1]³ in float64, always the same."""
    generator = torch.Generator().manual_seed(1)
    return torch.empty(count, 3, dtype=torch.float64).uniform_(-1, 1, generator=generator)
