"""Lights and nearby points at which light models tend to fail: values and all gradients are finite and
bounded.
"""

from __future__ import annotations

import math

import pytest
import torch

from neilfpp_method.fields.environment import EnvironmentLight
from neilfpp_method.fields.lamps import LampPlaces, Lamps
from neilfpp_method.lighting.fit import MapAndLamps, fit_light
from neilfpp_method.lighting.lamp_transport import from_lamps, in_sight, lamp_kernel
from neilfpp_method.lighting.map_transport import from_texels
from neilfpp_method.lighting.objective import Objective, Target
from neilfpp_method.shading.brdf import GGX, SPHERICAL_GAUSSIAN
from neilfpp_method.structures import Material, Observed
from tests.hard_cases.test_fields import DTYPES, assert_bounded

RADIUS = 0.06
UP = torch.tensor([0.0, 0.0, 1.0])
# In the lamp, on it, under it, behind its axis, level with it, and from far away.
BESIDE = torch.tensor(
    [
        [0.0, 0.0, 0.5],
        [0.0, 0.0, 0.44],
        [0.0, 0.0, 0.0],
        [0.0, 0.0, 0.9],
        [0.7, 0.0, 0.5],
        [300.0, 0.0, 0.0],
        [1e-20, 0.0, 0.5],
    ]
)
LAMPS = LampPlaces(torch.tensor([[0.0, 0.0, 0.5]]).expand(3, 3), torch.stack((-UP, UP, torch.zeros(3))))


def beside_lamps(dtype: torch.dtype, roughness: float) -> tuple[Observed, torch.Tensor]:
    count = len(BESIDE)
    up = UP.to(dtype).expand(count, 3)
    seen = Observed(BESIDE.to(dtype), up, up, torch.ones(count, 3, dtype=dtype))
    return seen, torch.full((count, 1), roughness, dtype=dtype)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("lobe", [GGX, SPHERICAL_GAUSSIAN, None], ids=["ggx", "gaussian", "lambertian"])
@pytest.mark.parametrize("roughness", [1e-4, 0.3, 1.0])
def test_lamps_that_touch_surfaces(dtype, lobe, roughness):
    seen, rough = beside_lamps(dtype, roughness)
    places = LampPlaces(LAMPS.position.to(dtype).requires_grad_(), LAMPS.axis.to(dtype).requires_grad_())
    rough.requires_grad_()
    sight = in_sight(places, RADIUS, seen.position, None)
    kernel = lamp_kernel(places, RADIUS, sight, seen, rough, lobe)
    assert kernel.dtype == torch.promote_types(dtype, torch.float32), "cosines are no matter for bf16"
    assert kernel.min() >= 0
    asked = [places.position, places.axis, rough]
    found = torch.autograd.grad(kernel.sum(), asked, allow_unused=True, materialize_grads=True)
    assert_bounded(kernel, *found, bound=1e30 if dtype == torch.float64 else 1e19)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("intensity", [0.0, 1e6])
def test_lamps_hit_by_directions(dtype, intensity):
    lamps = Lamps(4, RADIUS).to(dtype)
    lamps.place(LAMPS.position.to(dtype), torch.full((3, 3), intensity, dtype=dtype), LAMPS.axis.to(dtype))
    x = BESIDE.to(dtype)
    rays = lamps.rays_from(x)
    assert_bounded(rays.wi, rays.samples().pdf, lamps.arriving(rays), bound=1e10)
    seen = lamps.radiance_along(x, rays.wi, torch.full(rays.wi.shape[:2], math.inf, dtype=dtype))
    assert_bounded(seen, bound=1e10)
    assert (seen[2].max() > 0) == (intensity > 0)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("radiance", [1e-6, 1e6])
def test_a_map_at_its_poles_and_at_its_seam(dtype, radiance):
    torch.manual_seed(0)
    sky = EnvironmentLight(8, radiance).to(dtype)
    wi = torch.cat((torch.eye(3), -torch.eye(3), torch.tensor([[-1e-8, 1.0, 0.0], [1e-8, 1.0, 0.0]])))[
        None
    ].to(dtype)
    found = sky.radiance(torch.zeros(1, 3, dtype=dtype), wi)
    assert found.dtype == dtype
    torch.testing.assert_close(
        found, torch.full_like(found, radiance), rtol=0.1 if dtype == torch.bfloat16 else 1e-3, atol=0
    )
    technique = sky.technique(torch.tensor([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0]], dtype=dtype))
    drawn = technique.draw(16, True)
    pdf = technique.pdf(drawn)
    assert pdf.min() > 0
    assert_bounded(drawn, pdf, technique.pdf(wi.to(drawn).expand(2, -1, -1)))


@pytest.mark.parametrize("pixel", [0.0, 1e6])
@pytest.mark.parametrize(("base_color", "metallic"), [(0.0, 0.0), (1.0, 1.0)])
def test_a_fit_to_impossible_observations(pixel, base_color, metallic):
    """Black surfaces that emit light, mirrors that reflect nothing, and points beside and within lamps: the
    fitted light is finite and not negative.
    """
    torch.manual_seed(0)
    seen, rough = beside_lamps(torch.float32, 0.05)
    count = len(rough)
    material = Material(torch.full((count, 3), base_color), rough, torch.full((count, 1), metallic))
    sky = EnvironmentLight(4, 1.0)
    carried = from_texels(sky, seen, rough, GGX, None).concatenate(
        from_lamps(LAMPS, RADIUS, seen, rough, GGX, None)
    )
    start = MapAndLamps(sky.log_radiance, torch.zeros(3, 3))
    target = Target(seen.position, material, torch.full((count, 3), pixel))
    found = fit_light(start, carried, target, Objective("linear", max(pixel, 1.0), steps=50))
    assert_bounded(found.log_radiance, found.intensity, bound=1e12)
    assert found.intensity.min() >= 0
