"""The true light as a function: it reproduces the known directions, and its integrals agree with the known
ones.
"""

from __future__ import annotations

import pytest
import torch

from benchmarks.shading_samples import error_curves, scene_of, techniques
from benchmarks.true_light import true_light
from neilfpp_method.data.truth import LightField
from neilfpp_method.shading.sampling import combine, fibonacci
from neilfpp_method.structures import Material


def smooth(wi):
    """A smooth light with three different channels."""
    return torch.stack((1 + wi[..., 0], 2 + wi[..., 1] * wi[..., 2], 1.5 - 0.5 * wi[..., 2]), -1)


def sky(points: int = 6, directions: int = 4096) -> LightField:
    torch.manual_seed(0)
    normal = torch.nn.functional.normalize(torch.randn(points, 3), dim=-1)
    wi, wo = (combine([(fibonacci(normal), count)], stochastic=False).wi for count in (directions, 4))
    material = Material(torch.rand(points, 3), torch.rand(points, 1), torch.rand(points, 1))
    return LightField(torch.rand(points, 3), normal, material, wi, smooth(wi), wo, torch.ones_like(wo))


def test_known_directions_keep_their_radiance():
    field = sky()
    light = true_light(field.wi, field.incident)
    assert (light.radiance(field.wi) - field.incident).abs().mean() < 0.02
    inner = field.wi[:, :3000]  # well above the horizon
    assert (
        light.radiance(inner) - smooth(inner)
    ).abs().max() < 0.25  # at the poles, where cells are 14° wide
    second = light[torch.tensor([1])].radiance(inner[1:2])
    torch.testing.assert_close(second, light.radiance(inner)[1:2])


def test_the_mean_over_the_hemisphere_is_the_true_mean():
    field = sky()
    light = true_light(field.wi, field.incident)
    few = combine([(fibonacci(field.normal), 512)], stochastic=True).wi
    torch.testing.assert_close(light.radiance(few).mean(1), field.incident.mean(1), rtol=0.01, atol=0.01)


@pytest.mark.parametrize("name", list(techniques()))
def test_every_sampler_approaches_the_reference(name):
    """Smooth light on a rough surface: 256 directions are accurate to a few per cent, and more directions are
    more accurate.
    """
    scene = scene_of(sky())
    few, many = error_curves(scene, 1.0, {name: techniques()[name]}, counts=(8, 256))[name].y
    assert many < (0.6 if name == "lobe" else 0.1)  # a lobe alone seldom looks where the diffuse part does
    assert many < few
