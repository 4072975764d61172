"""The host and the method with extreme geometry: values and all gradients are finite."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from torch.nn.functional import normalize

from neilfpp_method.schedule import Stage, StagePosition, active_losses, weigh
from neilfpp_method.settings.plain import changed
from neilfpp_method.structures import PixelBatch
from neilfpp_method.train.optimizer import gradient_norms, make_optimizer, seed_step
from neilfpp_method.train.vanished import restore_surface
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
    """Rays that do not enter the scene: their intervals have length 0."""
    batch = sphere_batch()
    return dataclasses.replace(batch, directions=torch.tensor([[0.0, 1.0, 0.0]]).expand(len(batch), 3))


@pytest.mark.parametrize("batch", [from_inside, grazing, beside_the_scene])
@pytest.mark.parametrize("beta", [2e-2, 1.0001e-4])
@pytest.mark.parametrize("background", ["constant", "none", "inverted_sphere"])
@pytest.mark.parametrize("mode", ["soft", "hard"])
def test_every_stage_stays_finite(batch, beta, background, mode):
    config = changed(tiny_config(), {"host.volume.beta_init": beta})
    config = dataclasses.replace(
        config,
        shading=dataclasses.replace(config.shading, hit_share=1e-3),  # every ray with any weight is shaded
        light=dataclasses.replace(config.light, inter_reflection=mode),
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


@pytest.mark.parametrize("odd", [65504.0, 1e-42, 0.0], ids=["firefly", "denormal", "black"])
@pytest.mark.parametrize("rays", [1, 48])
def test_one_extreme_pixel_and_one_ray(odd, rays):
    """All fields stay finite."""
    model = sphere_model()
    batch = with_pixel(sphere_batch()[:rays], 0, odd)
    for stage in Stage:
        model.freeze_for(stage)
        optimizer = make_optimizer(model, model.config.optimizer)
        total = weigh(model.losses(batch, stage), active_losses(stage, model.config))
        total.loss.backward()
        assert total.loss.isfinite()
        optimizer.step()
        assert all(p.isfinite().all() for p in model.parameters())


FAR = {"color": 0.02, "base_color": 0.1, "light": 0.15}
"""Mean changes by a firefly: radiance of the host (0.3), base colour, and radiance of the light (0.6)."""


@pytest.mark.parametrize("stage", list(Stage))
@pytest.mark.usefixtures("without_shape_checks")
def test_one_firefly_changes_little_in_fifty_steps(stage):
    """Other pixels, the material and the light change no more than with other random numbers."""
    batch = sphere_batch()
    batch = dataclasses.replace(batch, color=batch.color * torch.linspace(0.5, 1.5, len(batch))[:, None])
    middle = int(batch.directions[:, :2].norm(dim=-1).argmin())
    usual, odd = (fifty_steps(b, stage, middle) for b in (batch, with_pixel(batch, middle, 65504.0)))
    changes = {name: (odd[name] - usual[name]).abs().mean().item() for name in FAR}
    assert all(changes[name] < FAR[name] for name in FAR), changes


def with_pixel(batch: PixelBatch, row: int, color: float) -> PixelBatch:
    colors = batch.color.clone()
    colors[row] = color
    return dataclasses.replace(batch, color=colors)


def fifty_steps(batch: PixelBatch, stage: Stage, odd: int) -> dict[str, torch.Tensor]:
    """What the fields say after fifty steps, at the pixels other than the odd one."""
    model = sphere_model()
    model.freeze_for(stage)
    optimizer = make_optimizer(model, model.config.optimizer)
    for step in range(50):
        seed_step(0, step)
        loss = weigh(model.losses(batch, stage), active_losses(stage, model.config)).loss
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    model.eval()
    hits = model.host.render(batch[torch.arange(len(batch)) != odd].rays)
    generator = torch.Generator().manual_seed(0)
    normal = normalize(torch.randn(16, 3, generator=generator), dim=-1)
    wi = normalize(torch.randn(16, 8, 3, generator=generator), dim=-1)
    return {
        "color": hits.color.detach(),
        "base_color": model.materials(hits.position).base_color.detach(),
        "light": model.incident_light(0.6 * normal, wi).detach(),
    }


@pytest.mark.hard
@pytest.mark.timeout(900)
@pytest.mark.usefixtures("without_shape_checks")
def test_ten_thousand_steps_with_beta_at_its_floor():
    """The surface is restored when it vanishes, as in the training loop."""
    config = tiny_config()
    model = sphere_model(changed(config, {"host.volume.beta_init": 1.0001e-4}))
    model.freeze_for(Stage.SDF_INIT)
    optimizer = make_optimizer(model, config.optimizer)
    beta = [group for group in optimizer.param_groups if group["name"] == "beta"]
    assert beta
    beta[0]["lr"] = 0.0  # β stays at its floor
    batches = [sphere_batch(4, spread=0.05 + 0.1 * k) for k in range(8)]
    for step in range(10_000):
        seed_step(0, step)
        terms = model.losses(batches[step % 8], Stage.SDF_INIT)
        loss = weigh(terms, active_losses(Stage.SDF_INIT, config)).loss
        optimizer.zero_grad()
        loss.backward()
        norms = torch.stack(list(gradient_norms(model).values()))
        assert norms.isfinite().all(), step
        optimizer.step()
        restore_surface(model.host, StagePosition(Stage.SDF_INIT, step + 1, 10_000))
    assert 1e-4 <= model.host.density.beta().item() < 1.001e-4
    # The images have one colour, which R must have learned.
    assert (model.host.render(batches[0].rays).color - 0.3).abs().mean() < 0.05
