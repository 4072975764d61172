"""Properties that hold for every input: values and gradients are finite, bounded, and continuous up to the
limits.

Hypothesis draws the inputs, among them 0, 1, and the smallest and largest numbers of a type, and simplifies
failing ones. Each property is tested in float64, float32, bfloat16 and float16.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from neilfpp_method.data.cameras.camera import Camera
from neilfpp_method.data.cameras.projection import camera_rays, project
from neilfpp_method.data.views import Normalization
from neilfpp_method.fields.encodings import direction_encoding, position_encoding
from neilfpp_method.fields.environment import EnvironmentLight
from neilfpp_method.fields.lamps import LampPlaces
from neilfpp_method.lighting.fit import MapAndLamps, fit_light
from neilfpp_method.lighting.lamp_transport import from_lamps
from neilfpp_method.lighting.map_transport import from_texels
from neilfpp_method.lighting.objective import Objective, Target
from neilfpp_method.settings.types import FrequencyConfig, HashGridConfig
from neilfpp_method.shading import LOBES, Sampling, evaluate, sample_directions, srgb_to_linear
from neilfpp_method.shading.brdf import GGX
from neilfpp_method.shading.color import linear_to_srgb, residual
from neilfpp_method.stratified.intervals import inverse_cdf_samples
from neilfpp_method.structures import Material
from neilfpp_method.volume.compositing import depth_weights
from neilfpp_method.volume.density import entering_depth, laplace_density, laplace_depth
from tests.hard_cases.test_fields import gradients
from tests.lighting.surfaces import material, points

DTYPES = (torch.float64, torch.float32, torch.bfloat16, torch.float16)
BOUND = {torch.float64: 1e36, torch.float32: 1e19, torch.bfloat16: 1e19, torch.float16: 1e19}
"""Bound on values and gradients of the BRDF: Adam squares gradients, which must not overflow."""
ROWS = 8
"""Number of rows of an example; hypothesis draws each number of each row."""

every_dtype = pytest.mark.parametrize("dtype", DTYPES, ids=str)
some_examples = settings(max_examples=25, deadline=None, derandomize=True)


def unit(columns: int, largest: float = 1.0) -> st.SearchStrategy[np.ndarray]:
    """Arrays (ROWS, columns) of numbers from 0 to `largest`."""
    return arrays(np.float64, (ROWS, columns), elements=st.floats(0.0, largest, width=32))


def direction(uv: np.ndarray, dtype: torch.dtype, lowest: float = -1.0) -> torch.Tensor:
    """Unit vectors (ROWS, 3) whose z is between `lowest` and 1, from two numbers in [0, 1] each."""
    z, turn = lowest + (1 - lowest) * uv[:, 0], 2 * np.pi * uv[:, 1]
    sine = np.sqrt(np.maximum(1 - z**2, 0))
    return torch.from_numpy(np.stack((sine * np.cos(turn), sine * np.sin(turn), z), -1)).to(dtype)


def assert_finite(*tensors: torch.Tensor, bound: float) -> None:
    for tensor in tensors:
        assert tensor.isfinite().all()
        assert tensor.abs().max() <= bound


# ------------------------------------------------------------------------------------------------------- BRDF


def brdf_of(parameters: np.ndarray, dtype: torch.dtype) -> tuple[Material, list[torch.Tensor]]:
    leaves = [torch.from_numpy(parameters[:, part]).to(dtype).requires_grad_() for part in PARTS]
    return Material(*leaves), leaves


PARTS = (slice(0, 3), slice(3, 4), slice(4, 5))
"""Columns of base color, roughness and metallic."""
UP = torch.tensor([0.0, 0.0, 1.0])


@every_dtype
@pytest.mark.parametrize("lobe", list(LOBES))
@some_examples
@given(unit(5), unit(2), unit(2))
def test_the_brdf_is_finite_and_not_negative(lobe, dtype, parameters, to_viewer, to_light):
    made_of, leaves = brdf_of(parameters, dtype)
    n = UP.to(dtype).expand(ROWS, 3).clone().requires_grad_()
    wo, wi = direction(to_viewer, dtype), direction(to_light, dtype)[:, None]
    value = evaluate(made_of, n, wo, wi, LOBES[lobe])
    total = value.diffuse + value.specular
    assert total.min() >= 0
    assert_finite(total, *torch.autograd.grad(total.sum(), [*leaves, n]), bound=BOUND[dtype])


@pytest.mark.parametrize("lobe", list(LOBES))
@some_examples
@given(unit(5), unit(2), unit(2))
def test_the_brdf_is_reciprocal(lobe, parameters, to_viewer, to_light):
    made_of, _ = brdf_of(parameters, torch.float64)
    n, above = UP.double().expand(ROWS, 3), 1e-3
    wo, wi = (direction(uv, torch.float64, lowest=above) for uv in (to_viewer, to_light))
    one, other = (evaluate(made_of, n, a, b[:, None], LOBES[lobe]).specular for a, b in ((wo, wi), (wi, wo)))
    torch.testing.assert_close(one, other, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("lobe", list(LOBES))
@some_examples
@given(unit(5), unit(2), unit(2))
def test_the_brdf_is_continuous_in_the_material(lobe, parameters, to_viewer, to_light):
    """A change of 1e-6 in any parameter, from 0 and from 1 as well, changes the value by a small share."""
    n = UP.double().expand(ROWS, 3)
    # A smooth lobe changes by a share of 1/r⁴ · the change of angle terms: at r = 0.05, by 1e-6 · 8 / r.
    parameters = parameters * np.array([1, 1, 1, 0.95, 1]) + np.array([0, 0, 0, 0.05, 0])
    moved = np.where(parameters > 0.5, parameters - 1e-6, parameters + 1e-6)
    wo, wi = (direction(uv, torch.float64, lowest=1e-3) for uv in (to_viewer, to_light))
    before, after = (
        evaluate(brdf_of(p, torch.float64)[0], n, wo, wi[:, None], LOBES[lobe]) for p in (parameters, moved)
    )
    for part in ("diffuse", "specular"):
        one, other = getattr(before, part), getattr(after, part)
        # Far from the mirror direction a Gaussian lobe underflows; only relevant values are compared.
        torch.testing.assert_close(one, other, rtol=0.1, atol=1e-5)


@some_examples
@given(unit(5), unit(2), unit(1))
def test_grazing_light_contributes_nothing(parameters, to_viewer, azimuth):
    """f · cos falls with the cosine of the light: no light comes from the horizon itself."""
    n = UP.double().expand(ROWS, 3)
    parameters[:, 3] = 0.1 + 0.9 * parameters[:, 3]
    made_of, _ = brdf_of(parameters, torch.float64)
    wo = direction(to_viewer, torch.float64, lowest=0.2)
    brought = []
    for cosine in (1e-4, 1e-6, 1e-8):
        low = np.concatenate((np.full((ROWS, 1), cosine), azimuth), -1)
        wi = direction(low, torch.float64, lowest=0.0)[:, None]
        value = evaluate(made_of, n, wo, wi, GGX)
        brought.append((cosine * (value.diffuse + value.specular)).max().item())
    assert brought[2] <= 2e-2 * brought[1] + 1e-12
    assert brought[1] <= 2e-2 * brought[0] + 1e-12


# --------------------------------------------------------------------------------------------------- samplers


@every_dtype
@pytest.mark.parametrize("kind", ["fibonacci", "cosine", "lobe", "mis"])
@some_examples
@given(unit(2), unit(2), unit(1), st.integers(1, 9), st.booleans())
def test_samplers_draw_unit_directions_of_finite_density(
    kind, dtype, normals, to_viewer, rough, count, moves
):
    n, wo = direction(normals, dtype), direction(to_viewer, dtype)
    roughness = torch.from_numpy(rough).to(dtype)
    material = Material(roughness.expand(-1, 3), roughness, roughness)
    drawn = sample_directions(Sampling(kind, count, GGX, stochastic=moves), n, wo, material)
    assert drawn.wi.shape == (ROWS, count, 3)
    # Normals of half precision are themselves off unit length by half a unit in the last place.
    assert (drawn.wi.norm(dim=-1) - 1).abs().max() < max(1e-5, 8 * torch.finfo(dtype).eps)
    assert drawn.pdf.min() >= 0
    # The density of a mirror's lobe is at most 1/(4π r⁴) / (wo·h), with r at its floor.
    assert_finite(drawn.pdf, bound=1e18 if dtype == torch.float64 else 1e9)


@every_dtype
@some_examples
@given(unit(6), st.floats(0, 1e4, width=32), st.integers(1, 9), st.booleans())
def test_samples_of_a_distribution_ascend_within_its_bounds(dtype, mass, span, count, moves):
    edges = torch.linspace(0, 1, 7, dtype=torch.float64).mul(span).to(dtype).expand(ROWS, 7)
    drawn = inverse_cdf_samples(edges, torch.from_numpy(mass).to(dtype), count, moves)
    assert (drawn.diff(dim=-1) >= 0).all()
    assert (drawn >= edges[:, :1]).all()
    assert (drawn <= edges[:, -1:]).all()


# ---------------------------------------------------------------------------------------------------- volumes


@every_dtype
@some_examples
@given(arrays(np.float64, (ROWS, 5), elements=st.floats(0, 6e4, width=32)), st.integers(-30, 0))
def test_weights_and_transmittance_add_up_to_one(dtype, depths, exponent):
    depth = torch.from_numpy(depths * 2.0**exponent).to(dtype).requires_grad_()
    found = depth_weights(depth)
    assert found.weights.min() >= 0
    torch.testing.assert_close(found.weights.sum(-1) + found.transmittance, torch.ones_like(found.opacity))
    torch.testing.assert_close(found.opacity, found.weights.sum(-1), rtol=1e-5, atol=0)
    (gradient,) = torch.autograd.grad(found.weights[:, 0].sum() + found.opacity.sum(), depth)
    assert_finite(gradient, bound=2.0)


@every_dtype
@some_examples
@given(
    arrays(np.float64, (ROWS,), elements=st.floats(-6e4, 6e4, width=32)),
    st.floats(1e-4, 1.0),
    st.floats(0, 1e-2),
)
def test_density_is_bounded_decreasing_and_continuous(dtype, distances, beta, step):
    scale = torch.tensor(beta, dtype=torch.promote_types(dtype, torch.float32)).requires_grad_()
    sdf = torch.from_numpy(distances).to(dtype).requires_grad_()
    density = laplace_density(sdf, scale)
    assert density.dtype == dtype
    assert density.min() >= 0
    assert density.max() <= (1 / scale).to(dtype)
    slope, by_scale = torch.autograd.grad(density.sum(), [sdf, scale])
    scale = scale.detach()
    slack = 4 * torch.finfo(dtype).eps / scale
    assert_finite(by_scale, bound=float(1.1 * ROWS / scale**2))
    # In float16 the slope on the surface is beyond the largest number below β = 2.8e-3.
    if 0.5 / scale**2 < torch.finfo(dtype).max:
        assert_finite(slope, bound=float(0.51 / scale**2))
    further = laplace_density(sdf.detach() + torch.tensor(step, dtype=dtype), scale)
    moved = (sdf.detach() + torch.tensor(step, dtype=dtype) - sdf.detach()).double()
    fallen = (density - further).double()
    assert (fallen >= -slack).all()
    assert (fallen <= 0.51 * moved / scale.double() ** 2 + slack).all()


@every_dtype
@some_examples
@given(
    arrays(np.float64, (ROWS, 4), elements=st.floats(-100, 100, width=32)),
    unit(3),
    st.floats(1e-4, 1.0),
)
def test_depth_is_finite_and_between_those_of_the_ends(dtype, distances, widths, beta):
    sdf = torch.from_numpy(distances).to(dtype).requires_grad_()
    scale = torch.tensor(beta, dtype=dtype).requires_grad_()
    along = torch.nn.functional.pad(torch.from_numpy(widths).cumsum(-1), (1, 0)).to(dtype)
    depth = laplace_depth(sdf, along, scale)
    assert depth.dtype == torch.promote_types(dtype, torch.float32)
    assert depth.min() >= 0
    wide = laplace_density(sdf.detach().to(depth.dtype), scale.detach().to(depth.dtype))
    most = torch.maximum(wide[:, 1:], wide[:, :-1]) * along.diff(dim=-1)
    assert (depth <= most * 1.01 + 1e-6).all()
    assert_finite(depth, *torch.autograd.grad(depth.sum(), [sdf, scale]), bound=1e12)


@every_dtype
@some_examples
@given(
    arrays(np.float64, (ROWS, 4), elements=st.floats(-100, 100, width=32)),
    st.floats(1e-4, 1.0),
)
def test_entering_depth_is_finite_and_at_least_that_of_the_smallest_distance(dtype, distances, beta):
    sdf = torch.from_numpy(distances).to(dtype).requires_grad_()
    scale = torch.tensor(beta, dtype=torch.promote_types(dtype, torch.float32)).requires_grad_()
    depth = entering_depth(sdf, scale)
    assert depth.dtype == torch.promote_types(dtype, torch.float32)
    assert depth.min() >= 0
    total = depth.detach().double().sum(-1)
    smallest = sdf.detach().double().amin(-1) / scale.detach().double()
    of_smallest = 0.5 * torch.exp(-smallest.abs()) + torch.relu(-smallest)
    assert (total >= of_smallest * (1 - 1e-4) - torch.finfo(torch.float32).tiny).all()
    slope, by_scale = torch.autograd.grad(depth.sum(), [sdf, scale])
    assert_finite(slope, bound=2.01 / scale.item())
    assert_finite(by_scale, bound=1e12)


# -------------------------------------------------------------------------------------------------- encodings

GRID = HashGridConfig(levels=3, log2_entries=8, sdf_log2_entries=8, max_resolution=32)
REACH = 1.75
"""Half of the edge of the cube that the grid covers."""


@every_dtype
@pytest.mark.parametrize("config", [GRID, FrequencyConfig()], ids=["hash", "frequency"])
@some_examples
@given(arrays(np.float64, (ROWS, 3), elements=st.floats(-60.0, 60.0, width=32)))
def test_encodings_are_finite_and_continuous(config, dtype, positions):
    torch.manual_seed(0)
    encoding = position_encoding(config, REACH).to(dtype)
    for table in encoding.parameters():
        torch.nn.init.uniform_(table, -1.0, 1.0)
    x = torch.from_numpy(positions).to(dtype).requires_grad_()
    encoded = encoding.with_jacobian(x)
    value = encoding(x)
    assert_finite(value[:, 3:], bound=1.02)
    assert_finite(encoded.jacobian, *gradients(value.sum(), encoding, x), bound=1e5)
    if dtype == torch.float64:
        step = 1e-7
        moved = encoding(x.detach() + step)
        # The steepest slope of a grid is 2 per cell, of a wave 2⁵; three axes.
        assert (moved - value).abs().max() <= step * 3 * max(2 * 32 / (2 * REACH) * 4, 2.0**5) + 1e-12


@every_dtype
@pytest.mark.parametrize("kind", ["frequency", "spherical_harmonics"])
@some_examples
@given(unit(2))
def test_direction_encodings_are_bounded(kind, dtype, uv):
    encoding = direction_encoding(kind, octaves=6, bands=4)
    d = direction(uv, dtype).requires_grad_()
    value = encoding(d)
    assert_finite(value, *gradients(value.sum(), encoding, d), bound=100.0)


# ------------------------------------------------------------------------------------------------------ color


@every_dtype
@some_examples
@given(arrays(np.float64, (ROWS, 3), elements=st.floats(-1.0, 6e4, width=32)))
def test_the_srgb_curve_is_increasing_and_inverted(dtype, colors):
    color = torch.from_numpy(np.sort(colors, 0)).to(dtype).requires_grad_()
    stored = linear_to_srgb(color)
    assert stored.dtype == dtype
    assert (stored.diff(dim=0) >= -4 * torch.finfo(dtype).eps * stored[1:].abs()).all()
    (slope,) = torch.autograd.grad(stored.sum(), color)
    assert_finite(stored, slope, bound=1e6)
    assert slope.min() >= 0
    if dtype in (torch.float64, torch.float32):
        torch.testing.assert_close(srgb_to_linear(stored), color, rtol=2e-5, atol=1e-6)


@every_dtype
@pytest.mark.parametrize("response", ["linear", "srgb"])
@some_examples
@given(arrays(np.float64, (ROWS, 3), elements=st.floats(0.0, 6e4, width=32)), unit(3))
def test_gradients_of_residuals_point_to_the_pixel(response, dtype, radiance, stored):
    value, pixel = torch.from_numpy(radiance).to(dtype).requires_grad_(), torch.from_numpy(stored).to(dtype)
    off = residual(value, pixel, response)
    (slope,) = torch.autograd.grad(off.abs().sum(), value)
    assert_finite(off, slope, bound=1e5)
    assert (slope * off >= 0).all(), "descent must bring the radiance nearer"


# ---------------------------------------------------------------------------------------------------- cameras


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=str)
@settings(max_examples=50, deadline=None, derandomize=True)
@given(
    unit(2),
    st.floats(-4, 4),
    st.floats(0, 1e4),
    st.floats(0.2, 20.0),
    arrays(np.float64, 2, elements=st.floats(-0.5, 1.5)),
)
def test_rays_project_back_to_their_pixels(dtype, uv, log_scale, away, focal, center):
    """A camera of any focal length, in scenes of any unit and position, in the scene frame."""
    forward, aside = direction(uv, torch.float64)[:2].numpy()
    right = np.cross(forward, aside)
    if np.linalg.norm(right) < 1e-3:
        right = np.cross(forward, [1.0, 0, 0] if abs(forward[0]) < 0.7 else [0, 1.0, 0])
    right /= np.linalg.norm(right)
    w2c = np.eye(4)
    w2c[:3, :3] = np.stack((right, np.cross(forward, right), forward))
    scale = 10.0**log_scale
    middle = away * scale * np.array([0.6, 0.0, -0.8])
    w2c[:3, 3] = -w2c[:3, :3] @ (middle - 3.0 * scale * forward)
    camera = Camera(8 * focal, 8 * focal, *(8 * center), 8, 6, w2c)
    scene = Normalization(scale, tuple(middle)).camera(camera)
    rays = camera_rays(scene, dtype)
    assert_finite(rays.origins, bound=3.1)
    torch.testing.assert_close(rays.directions.norm(dim=-1), torch.ones(48, dtype=dtype))
    seen = project(scene, rays.origins + 2.0 * rays.directions)
    row, column = torch.meshgrid(torch.arange(6) + 0.5, torch.arange(8) + 0.5, indexing="ij")
    wanted = torch.stack((column, row), -1).reshape(-1, 2).to(dtype)
    # An error of one unit in the last place of a position at distance 3 moves the image by that times fx / z.
    tolerance = 64 * torch.finfo(dtype).eps * (8 * focal + 16) / float(seen.depth.min()) * 3
    torch.testing.assert_close(seen.pixel, wanted, rtol=0, atol=tolerance)


# ------------------------------------------------------------------------------------------------- light fits


@settings(max_examples=8, deadline=None, derandomize=True)
@given(
    st.sampled_from([0.0, 1e-30, 1e-3, 1.0, 65504.0, 1e12]),
    st.sampled_from([0.0, 1e-3, 65504.0]),
    st.integers(0, 12),
    st.integers(0, 1000),
)
def test_a_light_fit_is_finite_and_not_negative(pixel, firefly, count, seed):
    """For any images of any number of points."""
    torch.manual_seed(seed)
    seen = points(count, seed)
    made_of = material(count, seed)
    color = torch.full((count, 3), pixel)
    color[: min(count, 1)] = firefly
    places = LampPlaces(torch.tensor([[0.0, 0.0, 0.5]]), torch.zeros(1, 3))
    sky = EnvironmentLight(4, 1.0)
    carried = from_texels(sky, seen, made_of.roughness, GGX, None).concatenate(
        from_lamps(places, 0.06, seen, made_of.roughness, GGX, None)
    )
    target = Target(seen.position, made_of, color)
    objective = Objective("linear", max(pixel, 1e-3), steps=20)
    found = fit_light(MapAndLamps(sky.log_radiance, torch.zeros(1, 3)), carried, target, objective)
    assert_finite(found.log_radiance, bound=100.0)
    assert_finite(found.intensity, bound=1e18)
    assert found.intensity.min() >= 0


@settings(max_examples=5, deadline=None, derandomize=True)
@given(st.integers(-13, 13), st.integers(0, 1000))
def test_a_light_fit_follows_the_unit_of_the_images(exponent, seed):
    seen, made_of = points(40, seed), material(40, seed)
    found = []
    for unit_of_images in (1.0, 2.0**exponent):
        torch.manual_seed(seed)
        sky = EnvironmentLight(4, unit_of_images)
        carried = from_texels(sky, seen, made_of.roughness, GGX, None)
        pixel = unit_of_images * (0.2 + seen.normal[:, 2:].clamp_min(0)).expand(40, 3)
        objective = Objective("linear", 0.5 * unit_of_images, steps=20)
        start = MapAndLamps(sky.log_radiance, torch.zeros(0, 3))
        target = Target(seen.position, made_of, pixel)
        found.append(fit_light(start, carried, target, objective).log_radiance)
    torch.testing.assert_close(found[1], found[0] + exponent * math.log(2), rtol=1e-3, atol=1e-3)
