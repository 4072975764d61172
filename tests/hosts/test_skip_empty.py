"""The VolSDF host with rays that skip empty space, and its checkpoints."""

from __future__ import annotations

import pytest
import torch

from neilfpp_method.hosts.volsdf import VolSdfHost
from neilfpp_method.incident import traced
from neilfpp_method.incident.traced import trace_light
from neilfpp_method.settings.facts import SceneFacts
from neilfpp_method.settings.plain import changed
from neilfpp_method.volume import empty_space
from neilfpp_method.volume.partition import SampleCounts
from tests.scenes import sphere_batch, tiny_config


def host(skip: bool = True) -> VolSdfHost:
    torch.manual_seed(0)
    config = changed(tiny_config(), {"host.volume.skip_empty": skip})
    return VolSdfHost(config, SceneFacts("linear", 0.2, 3.0, "constant"))


@pytest.fixture(autouse=True)
def _coarse(monkeypatch):
    monkeypatch.setattr(empty_space, "RESOLUTION", 24)


def test_images_skip_empty_space_and_agree_with_whole_rays():
    skipping, plain = host().eval(), host(skip=False).eval()
    plain.load_state_dict(skipping.state_dict(), strict=False)
    plain.sample_counts = SampleCounts(cuts=256, rounds=4, rendered=128)
    rays = sphere_batch(200, spread=1.2).rays
    with torch.no_grad():
        found, true = skipping.render(rays), plain.render(rays)
        assert torch.equal(found.color, skipping.render(rays).color)
    passes = true.opacity < 1e-6
    assert 40 < passes.sum() < 160
    assert torch.allclose(found.color[passes], true.color[passes], atol=1e-5)
    assert (found.opacity - true.opacity).abs().mean() < 0.01
    solid = true.opacity > 0.99
    assert (found.position - true.position)[solid].norm(dim=-1).max() < 0.02


def test_rays_that_miss_do_not_query_the_field(monkeypatch):
    skipping = host().eval()
    rays = sphere_batch(200, spread=1.2).rays
    with torch.no_grad():
        whole = skipping._march(rays).hits
        skipping.render(rays)  # samples the grid
        asked = []
        monkeypatch.setattr(skipping, "sdf", lambda x: asked.append(len(x)) or skipping.sdf_field(x))
        skipping.render(rays)
        skipping.render(rays[torch.nonzero(whole.opacity < 1e-9)[:, 0]])
    met = int((whole.opacity > 1e-3).sum())
    counts = skipping.sample_counts
    assert met * counts.of_narrowed_rays().cuts <= sum(asked) < 200 * counts.cuts


def test_images_follow_a_field_that_changes():
    skipping = host().eval()
    rays = sphere_batch(200, spread=1.2).rays
    with torch.no_grad():
        before = skipping.render(rays).opacity
        skipping.sdf_field.mlp.layers[-1].bias[0] -= 0.3  # distances: the sphere grows
        after, whole = skipping.render(rays).opacity, skipping._march(rays).hits.opacity
    assert (before > 0.5).sum() + 10 < (after > 0.5).sum()
    assert ((after > 0.5) == (whole > 0.5)).float().mean() > 0.98


@pytest.mark.parametrize("fused", [True, False])
def test_images_follow_a_field_that_is_trained(fused):
    """The fused optimizers change parameters without counting it in their versions."""
    training = host().train()
    training.density.above_floor.data.fill_(2e-3)
    rays = sphere_batch(200, spread=1.2).rays
    with torch.no_grad():
        before = training.eval().render(rays).opacity
    bias = training.sdf_field.mlp.layers[-1].bias
    optimizer = torch.optim.Adam([bias], lr=0.3, fused=fused)
    training.train().render_regularized(sphere_batch(), ())
    bias.grad = torch.ones_like(bias)
    optimizer.step()  # distances become smaller: the sphere grows
    with torch.no_grad():
        after, whole = training.eval().render(rays).opacity, training._march(rays).hits.opacity
    assert (before > 0.5).sum() + 10 < (after > 0.5).sum()
    assert ((after > 0.5) == (whole > 0.5)).float().mean() > 0.98


def test_evaluation_with_gradients_samples_whole_rays():
    skipping, plain = host().eval(), host(skip=False).eval()
    plain.sample_counts = skipping.sample_counts
    plain.load_state_dict(skipping.state_dict(), strict=False)
    rays = sphere_batch().rays
    torch.manual_seed(1)
    found = skipping.render(rays)
    torch.manual_seed(1)
    assert torch.equal(found.position, plain.render(rays).position)
    assert skipping.empty_space.age is None


def test_training_skips_empty_space_and_ages_the_grid():
    skipping = host().train()
    for _ in range(3):
        skipping.render_regularized(sphere_batch(), ())
    assert skipping.empty_space.age == 3
    with torch.no_grad():
        skipping.render_regularized(sphere_batch(), ("mask",))
    assert skipping.empty_space.age == 3  # the geometry was not trained


def test_a_stage_that_does_not_train_the_geometry_skips_as_much_as_evaluation(monkeypatch):
    skipping, batch = host().train(), sphere_batch(200, spread=1.2)
    with torch.no_grad():
        evaluated = skipping.eval().render(batch.rays)
        skipping.train()
        asked = []
        monkeypatch.setattr(skipping, "sdf", lambda x: asked.append(len(x)) or skipping.sdf_field(x))
        found = skipping.render_regularized(batch, ("physical", "volume")).hits
        spent = sum(asked)
        plain = skipping.render_regularized(batch, ("physical",)).hits
        asked.clear()
        skipping.render_regularized(batch, ("mask",))
    assert spent < 0.8 * sum(asked)
    assert skipping.empty_space.age == 0  # only the last call used the grid of training
    assert (found.opacity - evaluated.opacity).abs().mean() < 0.01
    assert (found.color - evaluated.color).abs().mean() < 0.01
    assert not plain.color.any()
    assert (plain.position - found.position).norm(dim=-1).median() < 0.01


def test_hits_do_not_change():
    skipping, plain = host().train(), host(skip=False).train()
    rays = sphere_batch().rays
    one, other = skipping.render(rays), plain.render(rays)
    solid = (one.opacity > 0.99) & (other.opacity > 0.99)
    assert solid.sum() > 5
    assert (one.position - other.position)[solid].norm(dim=-1).median() < 0.03


def test_traced_rays_that_hit_nothing_are_not_rendered(monkeypatch):
    """On a sphere no ray hits anything, so none is rendered. If the rays start in front of the sphere, all
    are rendered, with the same hits.
    """
    skipping, plain = host().train(), host(skip=False).train()
    plain.load_state_dict(skipping.state_dict(), strict=False)
    skipping.density.above_floor.data.fill_(2e-3)
    plain.density.above_floor.data.fill_(2e-3)
    out = torch.nn.functional.normalize(torch.randn(200, 3), dim=-1)
    settings = tiny_config()
    monkeypatch.setattr(traced, "MAX_ANGLE_DEG", 60.0)
    above = trace_light(skipping, 0.6 * out, out, settings)
    assert len(above.hit) < 20
    monkeypatch.setattr(traced, "MAX_ANGLE_DEG", 20.0)
    torch.manual_seed(1)
    towards = trace_light(skipping, 1.2 * out, -out, settings)
    torch.manual_seed(1)
    all_of_them = trace_light(plain, 1.2 * out, -out, settings)
    assert len(towards.hit) == len(all_of_them.hit)
    assert abs(towards.hit.float().mean() - all_of_them.hit.float().mean()) < 0.05


def test_no_ray_to_render_is_no_error():
    none = trace_light(host().train(), torch.zeros(0, 3), torch.zeros(0, 3), tiny_config())
    assert none.hit.shape == (0,)


def test_a_checkpoint_continues_with_the_same_grid():
    first = host().train()
    first.render_regularized(sphere_batch(), ())
    second = host().train()
    with torch.no_grad():
        for parameter in second.parameters():
            parameter.zero_()
    second.load_state_dict(first.state_dict())
    torch.manual_seed(5)
    one = first.render(sphere_batch().rays)
    torch.manual_seed(5)
    other = second.render(sphere_batch().rays)
    assert torch.equal(one.position, other.position)
    assert second.empty_space.age == 1
