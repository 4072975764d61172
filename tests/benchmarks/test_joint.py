"""The benchmark of whole steps: all rays meet the table, the distance field represents it, and all queries
are counted.
"""

from __future__ import annotations

import pytest
import torch

from benchmarks import joint
from benchmarks.joint import fitted_model, rays_at_the_table, seconds_of, step_on, table
from benchmarks.sampler import queries_per_ray
from neilfpp_method.hosts import volsdf
from neilfpp_method.settings.plain import changed
from tests.scenes import sphere_model, tiny_config


def test_all_rays_meet_the_table():
    rays = rays_at_the_table(64)
    assert len(rays) == 64
    depth = torch.zeros(64)
    for _ in range(100):
        depth += table(rays.origins + depth[:, None] * rays.directions)
    assert table(rays.origins + depth[:, None] * rays.directions).abs().max() < 2e-3


def test_a_field_is_fitted_to_the_table_and_copied_to_another_host(monkeypatch):
    monkeypatch.setattr(joint, "FIT_STEPS", 60)
    config = changed(tiny_config(), {"host.loss.hessian": (1e-3, 1e-3, 0.0)})
    x = torch.rand(500, 3) * 1.6 - 0.8
    fitted = fitted_model(config)
    off = (fitted.host.sdf(x) - table(x)).abs().mean()
    assert off < 0.5 * (sphere_model(config).host.sdf(x) - table(x)).abs().mean()
    assert torch.equal(fitted_model(config, like=fitted.host).host.sdf(x), fitted.host.sdf(x))
    step_on(fitted, rays_at_the_table(32))()
    assert all(p.grad.abs().sum() > 0 for p in fitted.host.sdf_field.mlp.parameters())


def test_every_query_of_the_sampler_is_counted(monkeypatch):
    host, said = sphere_model().host.eval(), []
    sampler = volsdf.error_bounded_samples

    def listen(*arguments):
        said.append(sampler(*arguments))
        return said[-1]

    monkeypatch.setattr(volsdf, "error_bounded_samples", listen)
    assert queries_per_ray(host, rays_at_the_table(64).rays) == pytest.approx(said[0].sdf_queries)
    assert said[0].sdf_queries >= host.sample_counts.cuts


def test_steps_alternate_and_each_follows_one_of_its_kind():
    calls = []
    taken = seconds_of(
        {"a": lambda: calls.append("a"), "b": lambda: calls.append("b")}, {"a": False, "b": True}
    )
    assert calls == ["a", "a", "b", "b"] * joint.REPETITIONS
    assert [len(taken[name]) for name in "ab"] == [joint.REPETITIONS] * 2
