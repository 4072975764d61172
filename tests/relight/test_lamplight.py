"""Lamps that are sampled by solid angle, compared with the closed forms of spheres."""

from __future__ import annotations

import math

import pytest
import torch

from neilfpp_method.fields.lamps import Lamps
from neilfpp_method.relight.lamplight import Lamplight, lamps_of_run


def light(*positions, axes=None, radiance=None, radius=0.1) -> Lamplight:
    position = torch.tensor(positions)
    axis = torch.zeros_like(position) if axes is None else torch.tensor(axes)
    return Lamplight(
        position, axis, torch.ones_like(position) if radiance is None else torch.tensor(radiance), radius
    )


def irradiance(lamps: Lamplight, count: int = 200_000) -> torch.Tensor:
    """Irradiance at the origin on a surface that faces +z."""
    u = torch.quasirandom.SobolEngine(3, scramble=True, seed=3).draw(count)
    drawn = lamps.sample(torch.zeros(count, 3), u)
    kept = drawn.pdf > 0
    wi, pdf, radiance = drawn.wi[kept], drawn.pdf[kept], drawn.radiance[kept]
    return (radiance * wi[:, 2:].clamp_min(0) / pdf[:, None]).double().sum(0) / count


def test_the_irradiance_of_a_sphere_agrees_with_the_closed_form():
    # π L (r/d)² times the cosine of the angle to its centre, for a sphere that is completely above the
    # horizon.
    expected = math.pi * (0.1 / 0.5) ** 2 * 0.8
    assert irradiance(light((0.3, 0.0, 0.4))).numpy() == pytest.approx(expected, rel=1e-3)


def test_a_distant_lamp_keeps_its_precision():
    assert irradiance(light((0.0, 0.0, 1000.0))).numpy() == pytest.approx(math.pi * 1e-8, rel=2e-3)


def test_lamps_are_summed_for_any_selection_probability():
    pair = light((0.3, 0.0, 0.4), (0.0, 0.0, 2.0), radiance=((1.0, 2.0, 3.0), (50.0, 10.0, 0.0)))
    one, other = math.pi * 0.04 * 0.8, math.pi * 0.0025
    expected = [one + 50 * other, 2 * one + 10 * other, 3 * one]
    assert irradiance(pair).numpy() == pytest.approx(expected, rel=3e-3)


def test_a_panel_emits_by_the_cosine_to_its_axis():
    radius, turned = 1e-3, (0.0, 0.6, -0.8)
    found = irradiance(light((0.0, 0.0, 1.0), axes=(turned,), radius=radius))
    assert found.numpy() == pytest.approx(0.8 * math.pi * radius**2, rel=2e-3)
    assert not irradiance(light((0.0, 0.0, 1.0), axes=((0.0, 0.0, 1.0),))).any()


def test_density_of_directions_that_hit_a_lamp():
    pair = light((0.3, 0.0, 0.4), (0.0, 0.0, 2.0))
    u = torch.rand(5000, 3, generator=torch.Generator().manual_seed(0))
    x = torch.zeros(5000, 3)
    drawn = pair.sample(x, u)
    for lamp in (0, 1):
        met = pair.intersect(x, drawn.wi, lamp)
        mine = (met.distance == drawn.distance) & met.distance.isfinite()
        assert mine.sum() > 10
        assert torch.allclose(pair.pdf(x, lamp)[mine], drawn.pdf[mine], rtol=1e-4)
        assert (met.radiance[mine] == 1).all()
    # Their shares, each spread over the solid angle of its lamp, add up to 1.
    total = sum(
        pair.pdf(x[:1], k).item() * 2 * math.pi * (1 - c) for k, c in ((0, 0.96**0.5), (1, 0.9975**0.5))
    )
    assert total == pytest.approx(1, rel=1e-3)


def test_a_point_inside_a_lamp_gets_no_sample():
    drawn = light((0.0, 0.0, 0.05)).sample(torch.zeros(10, 3), torch.rand(10, 3))
    assert not drawn.pdf.any()
    assert drawn.wi.isfinite().all()


def test_the_lamps_of_a_run():
    lamps = Lamps(4, 0.02)
    assert lamps_of_run(None) is None
    assert lamps_of_run(lamps) is None
    lamps.place(torch.tensor([[0.0, 0.0, 1.0]]), torch.tensor([[1.0, 2.0, 3.0]]))
    found = lamps_of_run(lamps)
    assert found.radiance.numpy() == pytest.approx(
        (torch.tensor([[1.0, 2.0, 3.0]]) / (math.pi * 0.02**2)).numpy()
    )
    # Irradiance of a bulb is intensity · cos / distance².
    assert irradiance(found).numpy() == pytest.approx([1.0, 2.0, 3.0], rel=2e-3)
