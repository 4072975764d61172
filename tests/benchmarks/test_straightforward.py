"""The plain implementation computes the same as the package: losses and gradients of a step agree on the same
directions.
"""

from __future__ import annotations

import dataclasses

import pytest
import torch
from torch.nn.functional import normalize

from benchmarks.straightforward import straightforward
from neilfpp_method.incident.traced import trace_light
from neilfpp_method.schedule import Stage
from neilfpp_method.settings.presets import paper_mlp
from neilfpp_method.settings.types import SdfConfig, VolSdfConfig
from neilfpp_method.structures import PixelBatch
from tests.scenes import sphere_batch, sphere_model, tiny_config


def small_paper():
    """The networks of the paper, with small sizes."""
    config, tiny = paper_mlp(), tiny_config()
    return dataclasses.replace(
        config,
        host=VolSdfConfig(
            sdf=SdfConfig(layers=4, width=32, feature_width=8),
            volume=dataclasses.replace(tiny.host.volume, samples=32, beta_init=0.01),
            loss=dataclasses.replace(config.host.loss, points="rays"),  # not drawn at random
        ),
        radiance=dataclasses.replace(config.radiance, layers=2, width=32),
        brdf=dataclasses.replace(config.brdf, layers=4, width=32),
        light=dataclasses.replace(config.light, layers=4, width=32),
        background=dataclasses.replace(config.background, radius=tiny.background.radius),
        shading=dataclasses.replace(config.shading, eval_samples=16, train_samples=16),
    )


def double(batch: PixelBatch) -> PixelBatch:
    return batch.map(lambda tensor: tensor.double() if tensor.is_floating_point() else tensor)


def test_losses_and_gradients_agree():
    """In evaluation mode, in which only the traced rays and the points of the Hessians are random."""
    names = ("volume", "eikonal", "surface", "physical", "smoothness", "lambertian")
    model = sphere_model(small_paper())
    found = []
    for computed in (model, straightforward(model)):
        computed.double().eval().freeze_for(Stage.JOINT)
        terms = computed.losses(double(sphere_batch(spread=0.3)), Stage.JOINT)
        sum(terms[name].mean() for name in names).backward()
        # Wrapped fields have names of their own; the order of the parameters is the same.
        gradients = [
            p.grad for group in computed.parameter_groups().values() for p in group if p.grad is not None
        ]
        found.append(([terms[name].mean().item() for name in names], gradients))
    (ours, our_gradients), (plain, plain_gradients) = found
    assert min(map(abs, ours)) > 0
    assert ours == pytest.approx(plain, rel=1e-6)
    assert len(our_gradients) > 30
    for one, other in zip(our_gradients, plain_gradients, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-6 * one.abs().max().item() + 1e-12)


def test_hessians_and_traced_light_agree():
    model = sphere_model(small_paper()).double().eval()
    plain = straightforward(model).double().eval()
    x = torch.randn(20, 3, dtype=torch.float64)
    one, other = (m.host.sdf_field.hessian(x, "analytic") for m in (model, plain))
    torch.testing.assert_close(one, other, rtol=1e-6, atol=1e-9)
    out = normalize(x, dim=-1)
    torch.manual_seed(0)
    ours = trace_light(model.host, 1.5 * out, -out, model.config)
    torch.manual_seed(0)
    theirs = trace_light(plain.host, 1.5 * out, -out, model.config)
    assert ours.hit.equal(theirs.hit)
    # The package adds no cuts to a converged ray: both opacities are accurate to ε, not to the
    # last digit.
    torch.testing.assert_close(ours.radiance, theirs.radiance, rtol=0.0, atol=1e-3)
