"""Inputs at which shading may fail: mirrors, horizons, lamps, half precision. Values and gradients are finite
and bounded.
"""

from __future__ import annotations

import itertools

import pytest
import torch

from neilfpp_method.shading import (
    LOBES,
    Sampling,
    apply_response,
    evaluate,
    sample_directions,
    shade,
    srgb_to_linear,
)
from neilfpp_method.shading.color import linear_to_srgb
from neilfpp_method.structures import Incident, IncidentSamples, Material

DTYPES = (torch.float64, torch.float32, torch.bfloat16)
ROUGHNESS = (0.0, 1e-4, 1e-2, 0.044, 0.1, 0.5, 1.0)
# Towards the normal, oblique, grazing, at the horizon exactly, just and far below it.
DIRECTIONS = (
    (0.0, 0.0, 1.0),
    (0.6, 0.0, 0.8),
    (-0.6, 0.0, 0.8),
    (1.0, 0.0, 1e-4),
    (-1.0, 0.0, 1e-4),
    (1.0, 0.0, 0.0),
    (-1.0, 0.0, 0.0),
    (0.0, 1.0, -1e-6),
    (0.0, -0.6, -0.8),
    (0.0, 0.0, -1.0),
)
# Adam squares gradients: in float32 its state stays finite up to 1e19. In float64 a lobe may be sharper and
# higher.
BOUND = {torch.float64: 1e36, torch.float32: 1e19, torch.bfloat16: 1e19}

dtypes = pytest.mark.parametrize("dtype", DTYPES, ids=str)
lobes = pytest.mark.parametrize("lobe", list(LOBES))


def hard_scene(dtype: torch.dtype):
    """Every roughness with metallic 0 and 1 seen from every direction; every wi, wi = ±wo among them."""
    rows = list(itertools.product(ROUGHNESS, (0.0, 1.0), DIRECTIONS))
    count = len(rows)
    leaf = {
        "base_color": torch.tensor([0.0, 0.5, 1.0]).expand(count, 3),
        "roughness": torch.tensor([[r] for r, _, _ in rows]),
        "metallic": torch.tensor([[m] for _, m, _ in rows]),
        "n": torch.tensor([0.0, 0.0, 1.0]).expand(count, 3),
    }
    leaf = {name: values.to(dtype, copy=True).requires_grad_() for name, values in leaf.items()}
    wo = torch.tensor([d for _, _, d in rows]).to(dtype)
    wi = torch.tensor(DIRECTIONS).expand(count, -1, -1).to(dtype)
    return leaf, Material(leaf["base_color"], leaf["roughness"], leaf["metallic"]), wo, wi


def assert_tame(value: torch.Tensor, leaves: dict[str, torch.Tensor], bound: float) -> None:
    assert value.isfinite().all()
    assert value.abs().max() < bound
    gradients = torch.autograd.grad(value.sum(), list(leaves.values()), allow_unused=True)
    for name, gradient in zip(leaves, gradients, strict=True):
        if gradient is not None:
            assert gradient.isfinite().all(), name
            assert gradient.abs().max() < bound, name


@dtypes
@lobes
@pytest.mark.parametrize("part", ["diffuse", "specular"])
def test_the_brdf_is_bounded_and_not_negative(lobe, dtype, part):
    leaf, material, wo, wi = hard_scene(dtype)
    value = getattr(evaluate(material, leaf["n"], wo, wi, LOBES[lobe]), part)
    assert_tame(value, leaf, BOUND[dtype])
    assert value.ge(0).all()
    assert value[:, 5:].eq(0).all()


@dtypes
@lobes
@pytest.mark.parametrize("light", [0.0, 1e6])
def test_shaded_radiance_is_bounded_and_not_negative(lobe, dtype, light):
    leaf, material, wo, wi = hard_scene(dtype)
    leaf["radiance"] = torch.full_like(wi, light).requires_grad_()
    samples = IncidentSamples(wi, torch.full_like(wi[..., 0], 0.159))
    color = shade(material, leaf["n"], wo, Incident.of(samples, leaf["radiance"]), LOBES[lobe]).color
    assert_tame(color, leaf, BOUND[dtype])
    assert color.ge(0).all()
    assert light > 0 or color.eq(0).all()


@dtypes
@lobes
def test_a_pdf_of_zero_causes_no_division_by_zero(lobe, dtype):
    leaf, material, wo, wi = hard_scene(dtype)
    samples = IncidentSamples(wi, torch.zeros_like(wi[..., 0]))
    color = shade(material, leaf["n"], wo, Incident.of(samples, torch.ones_like(wi)), LOBES[lobe]).color
    assert_tame(color, leaf, BOUND[dtype])


@dtypes
@lobes
@pytest.mark.parametrize("kind", ["fibonacci", "cosine", "lobe", "mis"])
def test_sampled_directions_and_their_estimate_are_bounded(kind, lobe, dtype):
    torch.manual_seed(0)
    leaf, material, wo, _ = hard_scene(dtype)
    samples = sample_directions(Sampling(kind, 64, LOBES[lobe], stochastic=True), leaf["n"], wo, material)
    assert samples.pdf.isfinite().all()
    assert samples.pdf.ge(0).all()
    assert (samples.wi.norm(dim=-1) - 1).abs().max() < (0.02 if dtype == torch.bfloat16 else 1e-5)
    leaf["radiance"] = torch.full_like(samples.wi, 1e6).requires_grad_()
    assert_tame(
        shade(material, leaf["n"], wo, Incident.of(samples, leaf["radiance"]), LOBES[lobe]).color,
        leaf,
        BOUND[dtype],
    )


@lobes
@pytest.mark.parametrize("kind", ["lobe", "mis"])
def test_importance_samples_of_a_mirror_cause_no_fireflies(kind, lobe):
    """The density cancels D, so that even at the floor of the roughness no float32 sample is brighter than
    the light.
    """
    torch.manual_seed(1)
    r = torch.tensor([[1e-4], [0.05], [0.1]])
    n, wo = torch.tensor([[0.0, 0.0, 1.0]]).expand(3, 3), torch.tensor([[0.6, 0.0, 0.8]]).expand(3, 3)
    material = Material(torch.ones(3, 3), r, torch.ones(3, 1))
    samples = sample_directions(Sampling(kind, 4096, LOBES[lobe], stochastic=True), n, wo, material)
    single = IncidentSamples(samples.wi.reshape(-1, 1, 3), samples.pdf.reshape(-1, 1))
    many = Material(*(t.repeat_interleave(4096, 0) for t in (material.base_color, r, material.metallic)))
    light = torch.ones_like(single.wi)
    color = shade(
        many,
        n[:1].expand(len(light), 3),
        wo[:1].expand(len(light), 3),
        Incident.of(single, light),
        LOBES[lobe],
    ).color
    assert color.max() < 2.5
    # Under unit light, the outgoing radiance of a mirror is 1 for any roughness.
    assert (color[:, 0].reshape(3, -1).mean(1) - 1).abs().max() < 0.02


@dtypes
def test_srgb_at_and_beyond_its_limits(dtype):
    color = torch.tensor([-1e6, -1.0, 0.0, 0.0031308, 0.04045, 1.0, 1.5, 1e6]).to(dtype).requires_grad_()
    for curve in (linear_to_srgb, srgb_to_linear, lambda c: apply_response(c, "srgb")):
        assert_tame(curve(color), {"color": color}, 1e16)
