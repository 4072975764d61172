"""The host and the method where geometry is at its worst: value and every gradient finite."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from torch.nn.functional import normalize

from neilfpp_method.schedule import Stage, active_losses, weigh
from tests.scenes import sphere_batch, sphere_model, tiny_config


def from_inside():
    """Rays from the centre of the object outwards."""
    batch = sphere_batch()
    return dataclasses.replace(batch, origins=torch.zeros_like(batch.origins))


def grazing():
    """Rays that touch the sphere, from a camera on the rim of the scene."""
    batch = sphere_batch()
    targets = 0.6 * normalize(
        torch.cat([batch.directions[:, :2], torch.zeros(len(batch), 1)], dim=-1), dim=-1
    )
    return dataclasses.replace(batch, directions=normalize(targets - batch.origins, dim=-1))


def beside_the_scene():
    """Rays that never enter the scene: their intervals have no length."""
    batch = sphere_batch()
    return dataclasses.replace(batch, directions=torch.tensor([[0.0, 1.0, 0.0]]).expand(len(batch), 3))


@pytest.mark.parametrize("batch", [from_inside, grazing, beside_the_scene])
@pytest.mark.parametrize("beta", [2e-2, 1.0001e-4])
@pytest.mark.parametrize("background", ["constant", "none", "inverted_sphere"])
@pytest.mark.parametrize("mode", ["soft", "hard"])
def test_every_stage_stays_finite(batch, beta, background, mode):
    config = tiny_config()
    config = dataclasses.replace(
        config,
        volume=dataclasses.replace(config.volume, beta_init=beta),
        shading=dataclasses.replace(config.shading, hit_share=1e-3),  # whatever a ray met is shaded
        inter_reflection=dataclasses.replace(config.inter_reflection, mode=mode),
    )
    model = sphere_model(config, background=background)
    for stage in Stage:
        model.zero_grad()
        total = weigh(model.losses(batch(), stage), active_losses(stage, config))
        total.loss.backward()
        assert total.loss.isfinite()
        assert all(p.grad is None or p.grad.isfinite().all() for p in model.parameters())


@pytest.mark.parametrize("radiance", [0.0, 1e6])
def test_black_and_blinding_pixels(radiance):
    model = sphere_model()
    batch = sphere_batch(color=radiance)
    for stage in Stage:
        model.zero_grad()
        total = weigh(model.losses(batch, stage), active_losses(stage, model.config))
        total.loss.backward()
        assert total.loss.isfinite()
        assert all(p.grad is None or p.grad.isfinite().all() for p in model.parameters())
