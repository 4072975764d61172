"""The path tracer compared with closed forms and quadrature."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
import trimesh
from torch.nn.functional import normalize

from neilfpp_method.relight import path_tracer
from neilfpp_method.relight.lamplight import Lamplight
from neilfpp_method.relight.path_tracer import DIMENSIONS, Scene, power_heuristic, trace_paths
from neilfpp_method.relight.sequence import SobolSequence
from neilfpp_method.relight.sky import Sky
from neilfpp_method.relight.surface import Surface
from neilfpp_method.shading.brdf import GGX, SPHERICAL_GAUSSIAN
from neilfpp_method.structures import Material, RayBatch
from tests import oracles

EVEN = Sky(torch.ones(8, 16, 3), rows_at_poles=True, start=0.0)


def made_of(base: float, roughness: float = 0.5, metallic: float = 0.0):
    return lambda x: Material(
        *(torch.full_like(x[:, :k], v) for k, v in ((3, base), (1, roughness), (1, metallic)))
    )


def ball(subdivisions: int = 3, inside_out: bool = False) -> Surface:
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=0.6)
    triangles = torch.tensor(np.array(mesh.triangles), dtype=torch.float32)
    return Surface(triangles.flip(1) if inside_out else triangles)


def squares(*corners) -> Surface:
    """A square for each corner with its two edges; it faces the direction edge × edge."""
    found = []
    for corner, first, second in corners:
        a, b, c = (torch.tensor(v, dtype=torch.float32) for v in (corner, first, second))
        found += [torch.stack((a, a + b, a + b + c)), torch.stack((a, a + b + c, a + c))]
    return Surface(torch.stack(found))


def trace(scene: Scene, rays: RayBatch, samples: int, bounces: int) -> torch.Tensor:
    """Mean radiance of each ray (N, 3)."""
    sequence, total = (
        SobolSequence(bounces * DIMENSIONS, seed=7),
        torch.zeros(len(rays), 3, dtype=torch.float64),
    )
    numbers = sequence.next(samples, len(rays))
    traced = trace_paths(scene, rays[numbers.pixel], numbers, bounces)
    return total.index_add_(0, numbers.pixel, traced.radiance.double()) / samples


def looking_at(points, eye=(0.0, 0.0, 3.0)) -> RayBatch:
    targets = torch.as_tensor(points, dtype=torch.float32)
    origins = torch.tensor([eye]).expand_as(targets)
    return RayBatch(origins, normalize(targets - origins, dim=-1))


# ------------------------------------------------------------------------------------------------ the furnace


def scattered_targets(count: int, radius: float = 0.5) -> torch.Tensor:
    generator = torch.Generator().manual_seed(4)
    return torch.cat(
        (radius * (2 * torch.rand(count, 2, generator=generator) - 1), torch.zeros(count, 1)), -1
    )


def test_a_white_ball_in_white_light_is_invisible():
    found = trace(
        Scene(ball(), made_of(1.0), None, EVEN), looking_at(scattered_targets(500, 0.35)), 256, bounces=1
    )
    assert found.mean().item() == pytest.approx(1, abs=1e-3)


def test_a_white_bowl_in_white_light_is_invisible():
    """With a dozen bounces and paths that are terminated by Russian roulette."""
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.6)
    kept = mesh.triangles[mesh.triangles_center[:, 2] < 0.2]
    bowl = Surface(torch.tensor(np.array(kept), dtype=torch.float32).flip(1))
    found = trace(
        Scene(bowl, made_of(1.0), None, EVEN), looking_at(scattered_targets(100, 0.2)), 512, bounces=64
    )
    assert found.mean().item() == pytest.approx(1, abs=4e-3)


@pytest.mark.parametrize("lobe", [GGX, SPHERICAL_GAUSSIAN])
@pytest.mark.parametrize(("roughness", "metallic"), [(0.15, 1.0), (0.5, 1.0), (0.5, 0.0)])
def test_a_surface_in_white_light_has_its_directional_albedo(lobe, roughness, metallic):
    plane = squares(((-0.5, -0.5, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)))
    eye = (1.8, 0.0, 2.4)  # cosine 0.8
    scene = Scene(plane, made_of(1.0, roughness, metallic), lobe, EVEN)
    found = trace(scene, looking_at([(0.0, 0.0, 0.0)] * 32, eye), 1024, bounces=1).mean().item()
    # In the angle to the mirror direction's half vector the integrand is smooth: h by Gauss-Legendre in θ_h.
    name = "ggx" if lobe is GGX else "spherical_gaussian"
    assert found == pytest.approx(directional_albedo(name, roughness, metallic, 0.8), rel=3e-3)


def directional_albedo(name: str, roughness: float, metallic: float, cosine: float) -> float:
    """∫ f cos dwi by quadrature in the half vector, dwi = 4 |wo·h| dh, and in wi for the diffuse part."""
    nodes, weights = np.polynomial.legendre.leggauss(1000)
    theta = (nodes + 1) * np.pi / 4
    azimuth = 2 * np.pi * (np.arange(256) + 0.5) / 256
    h = oracles.spherical(np.cos(theta)[:, None], azimuth[None])
    wo, up = np.array([math.sqrt(1 - cosine**2), 0.0, cosine]), np.array([0.0, 0.0, 1.0])
    along = (h * wo).sum(-1, keepdims=True)
    wi = 2 * along * h - wo
    values = [np.array([v]) for v in (1.0, roughness, metallic)]
    _, specular = oracles.brdf(name, *values, up, wo, wi)
    area = np.sin(theta)[:, None] * weights[:, None] * np.pi / 4 * 2 * np.pi / 256
    integrand = specular[..., 0] * wi[..., 2] * 4 * along[..., 0] * (along[..., 0] > 0)
    return float((integrand * area).sum() + (1 - metallic))


# ----------------------------------------------------------------------------------------------- direct light


@pytest.fixture(scope="module")
def gradient() -> Sky:
    """A sky with a bright spot that becomes darker downwards."""
    radiance = torch.linspace(1.0, 0.1, 12)[:, None, None].expand(12, 24, 3).clone()
    radiance[3, 4] = torch.tensor([30.0, 20.0, 10.0])
    return Sky(radiance, rows_at_poles=True, start=0.3)


def quadrature(
    sky: Sky, normal: np.ndarray, wo: np.ndarray, base: float, roughness: float, metallic: float
) -> np.ndarray:
    """Outgoing radiance of a convex surface: the rendering equation with a quarter of a million evenly spread
    directions.
    """
    count = 500_000
    k = np.arange(count) + 0.5
    wi = oracles.spherical(1 - 2 * k / count, np.pi * (3 - 5**0.5) * k)
    wi = wi[wi @ normal > 0]
    values = [np.array([v]) for v in (base, roughness, metallic)]
    diffuse, specular = oracles.brdf("ggx", *values, normal, wo, wi)
    light = sky.lookup(torch.from_numpy(wi).float()).double().numpy()
    return ((diffuse + specular) * light * (wi @ normal)[:, None]).sum(0) * 4 * np.pi / count


@pytest.mark.parametrize(("roughness", "metallic"), [(0.4, 1.0), (0.6, 0.2)])
def test_a_ball_under_a_map_agrees_with_quadrature(gradient, roughness, metallic):
    surface, targets = ball(), scattered_targets(4, 0.35)
    rays = looking_at(targets)
    met = surface.intersect(rays.origins, rays.directions)
    found = trace(Scene(surface, made_of(0.6, roughness, metallic), GGX, gradient), rays, 4096, bounces=3)
    for k in range(len(rays)):
        normal, wo = met.flat[k].double().numpy(), -rays.directions[k].double().numpy()
        expected = quadrature(gradient, normal, wo, 0.6, roughness, metallic)
        assert found[k].numpy() == pytest.approx(expected, rel=0.015)


@pytest.mark.parametrize("lobe", [None, GGX])
def test_both_techniques_together_and_each_alone_agree(gradient, lobe, monkeypatch):
    """Light sampling and BRDF sampling: their weighted sum equals the result of either."""
    scene = Scene(
        squares(
            ((-0.5, -0.5, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
            ((-0.5, 0.2, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 0.4)),
        ),
        made_of(0.7, 0.5, 0.3),
        lobe,
        gradient,
        Lamplight(torch.tensor([[0.2, -0.2, 0.5]]), torch.zeros(1, 3), torch.full((1, 3), 20.0), 0.15),
    )
    rays, found = looking_at([(0.0, -0.1, 0.0)] * 64), {}
    found["both"] = trace(scene, rays, 512, bounces=3).mean(0)

    def silent_light(scene, *rest):
        return torch.zeros(1, 3)

    with monkeypatch.context() as patch:
        patch.setattr(path_tracer, "power_heuristic", lambda own, other: torch.ones_like(own))
        patch.setattr(path_tracer, "_from_hit_lights", silent_light)
        found["by the light"] = trace(scene, rays, 512, bounces=3).mean(0)
    with monkeypatch.context() as patch:
        patch.setattr(path_tracer, "power_heuristic", lambda own, other: torch.ones_like(own))
        patch.setattr(path_tracer, "_from_sky", silent_light)
        patch.setattr(path_tracer, "_from_lamps", silent_light)
        found["by the surface"] = trace(scene, rays, 1024, bounces=3).mean(0)
    for name in ("by the light", "by the surface"):
        assert found[name].numpy() == pytest.approx(found["both"].numpy(), rel=0.02), name


def test_weights_of_both_techniques_add_up_to_one():
    own, other = torch.rand(1000) * 1e4, torch.rand(1000)
    assert torch.allclose(power_heuristic(own, other) + power_heuristic(other, own), torch.ones(1000))
    assert power_heuristic(torch.zeros(1), torch.ones(1)) == 0
    assert power_heuristic(torch.full((1,), 1e30), torch.full((1,), 1e25)) == 1


def test_a_lamp_casts_a_shadow():
    floor, lid = (
        ((-2.0, -2.0, 0.0), (4.0, 0.0, 0.0), (0.0, 4.0, 0.0)),
        ((-0.3, -0.3, 0.5), (0.6, 0.0, 0.0), (0.0, 0.6, 0.0)),
    )
    black = Sky(torch.full((4, 8, 3), 1e-9), True, 0.0)
    lamps = Lamplight(torch.tensor([[0.0, 0.0, 1.0]]), torch.zeros(1, 3), torch.ones(1, 3), 0.05)
    scene = Scene(squares(floor, lid), made_of(0.5), None, black, lamps)
    found = trace(scene, looking_at([(0.2, 0.0, 0.0), (1.5, 0.0, 0.0)], eye=(3.0, 0.0, 0.2)), 1024, bounces=1)
    distance = math.sqrt(1.5**2 + 1)
    lit = 0.5 / math.pi * math.pi * (0.05 / distance) ** 2 / distance
    assert found[0].max() < 1e-8
    assert found[1].numpy() == pytest.approx(lit, rel=2e-3)


def test_cameras_see_neither_lamps_nor_sky():
    lamps = Lamplight(torch.tensor([[0.0, 0.0, 2.0]]), torch.zeros(1, 3), torch.ones(1, 3), 0.2)
    rays = looking_at([(0.0, 0.0, 0.0), (5.0, 0.0, 0.0)])
    numbers = SobolSequence(DIMENSIONS, 0).next(1, 2)
    traced = trace_paths(Scene(ball(), made_of(0.0), None, EVEN, lamps), rays, numbers, 1)
    assert not traced.radiance.any()
    assert traced.alpha.tolist() == [1.0, 0.0]


# --------------------------------------------------------------------------------------- light between planes

FACING = (
    ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
    ((0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (1.0, 0.0, 0.0)),
)
"""Unit squares that look at one another across a distance of 1."""


def series(albedo: float, lit: float, point: np.ndarray, terms: int) -> list[float]:
    """Outgoing radiance of a point on the upper square, by the number of reflections at either square.

    The lower square is lit uniformly and sends `lit` · albedo / π. Each further term is the integral of the
    previous one over the other square with the kernel cos cos / (π d²) of form factors, by Gauss-Legendre
    nodes.
    """
    nodes, weights = np.polynomial.legendre.leggauss(24)
    x, w = (nodes + 1) / 2, weights / 2
    at = np.stack(np.meshgrid(x, x, indexing="ij"), -1).reshape(-1, 2)
    area = (w[:, None] * w[None]).reshape(-1)

    def kernel(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return 1 / (np.pi * (((a[:, None] - b[None]) ** 2).sum(-1) + 1) ** 2)

    between, to_point = kernel(at, at) * area, kernel(point[None], at)[0] * area
    sent, found = np.full(len(at), albedo * lit), []
    for _ in range(terms):  # `sent` is the radiosity of the lower square
        found.append(albedo * (to_point @ sent) / np.pi)
        sent = albedo * (between @ (albedo * (between @ sent)))
    return found


def test_light_between_two_planes_agrees_with_form_factors():
    # Light from far to the side, at 45°: it reaches the whole lower square and only the back of the upper
    # one.
    radius, far = 10.0, 2000.0
    lamps = Lamplight(torch.tensor([[far, 0.5, far]]), torch.zeros(1, 3), torch.full((1, 3), 1e5), radius)
    lit = math.pi * 1e5 * radius**2 / (2 * far**2) / math.sqrt(2)
    dark = Sky(torch.full((4, 8, 3), 1e-12), True, 0.0)
    scene = Scene(squares(*FACING), made_of(0.8), None, dark, lamps)
    point = np.array([0.4, 0.6])
    rays = looking_at([(*point, 1.0)] * 256, eye=(0.5, 0.5, 0.5))
    expected = series(0.8, lit, point, terms=4)
    # The upper square sends light after 2, 4, 6, … surfaces; beyond 8 its share is 1e-4.
    for bounces, terms in ((1, 0), (2, 1), (4, 2), (8, 4)):
        found = trace(scene, rays, 256, bounces).mean().item()
        assert found == pytest.approx(sum(expected[:terms]), rel=0.01, abs=1e-6), bounces
    # The first term is the form factor of a differential area and a parallel square (Howell's catalogue,
    # B-3).
    assert expected[0] == pytest.approx(0.8 * 0.8 * lit / math.pi * point_form_factor(*point), rel=1e-6)


def point_form_factor(x: float, y: float) -> float:
    """Form factor from a small area to a parallel unit square at distance 1, below the point (x, y) of the
    square.
    """

    def corner(a: float, b: float) -> float:
        p, q = math.sqrt(1 + a * a), math.sqrt(1 + b * b)
        return (a / p * math.atan(b / p) + b / q * math.atan(a / q)) / (2 * math.pi)

    return corner(x, y) + corner(1 - x, y) + corner(x, 1 - y) + corner(1 - x, 1 - y)
