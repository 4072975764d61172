"""Hard materials and lights with a known truth: what training recovers is right, not only finite.

The images are those of `known_ball`, made by quadrature apart from the package. An attached host knows the
geometry, or the host is the ball as a mesh; material, and in some cases light, is learned. Each bound is 1.5
to 2 times the error measured, and below the error of a constant answer (`test_degenerate_answers`), so no
true roughness is 0.5. What the images cannot tell has no bound: the roughness of a white surface under even
light, the metallic of a black one.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from torch.nn.functional import normalize

from neilfpp_method.attach import AttachedNeilf, attach_neilf, pixel_batch
from neilfpp_method.data.files.images import write_exr
from neilfpp_method.data.mesh import Mesh
from neilfpp_method.fields.environment import EnvironmentLight
from neilfpp_method.hosts.mesh import MeshHost
from neilfpp_method.settings.facts import SceneFacts
from neilfpp_method.settings.plain import changed
from neilfpp_method.settings.types import NeilfConfig
from neilfpp_method.shading import LOBES, Sampling, sample_directions, shade
from neilfpp_method.structures import Incident, Material, PixelBatch, RayBatch
from tests.data.make_capture import srgb
from tests.hard_cases.known_ball import RADIUS, Array, KnownBall, Photographed, photograph, sky, sun
from tests.hard_cases.material_errors import Answer, Errors, compare
from tests.hard_cases.small_presets import small_mesh, small_paper_ngp
from tests.scenes import meet_ball, tiny_config
from tests.train.small_runs import solved_light

pytestmark = pytest.mark.usefixtures("without_shape_checks")

PIXELS, HELD_BACK, RAYS = 1500, 300, 128


def closed_form_host(origins: torch.Tensor, directions: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """The ball without a colour: the host's colour has no influence if only the material is trained."""
    position, hit = meet_ball(RayBatch(origins, directions), RADIUS)
    return torch.full_like(position, 0.5), position, normalize(position, dim=-1) * hit[:, None]


def ball_mesh(median: float, config: NeilfConfig) -> MeshHost:
    """The ball as a mesh of 5120 triangles, with a small R to train.

    Rays between its points are traced and find nothing, because the ball is convex.
    """
    sphere = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS)
    mesh = Mesh(torch.from_numpy(np.array(sphere.vertices)).float(), torch.from_numpy(np.array(sphere.faces)))
    return MeshHost(mesh, small_mesh(config), SceneFacts("linear", median, 20 * median, "constant"))


def settings_of_paper_ngp(steps: int, mesh: bool) -> NeilfConfig:
    """`small_paper_ngp`, whose light field is learned with the material in `steps` steps.

    On a mesh, the published rates suit 36,000 steps; those of the preset without a mesh are taken instead.
    """
    config = small_mesh(small_paper_ngp()) if mesh else small_paper_ngp()
    rates = dict.fromkeys(("optimizer.radiance", "optimizer.brdf", "optimizer.light"), 1e-2)
    stages = {"train.sdf_steps": 0, "train.material_steps": steps, "train.joint_steps": 0}
    return changed(config, {**stages, **(rates if mesh else {})})


def settings(steps: int, known_map: Path | None) -> NeilfConfig:
    """A small material field trained for `steps` steps, under a known map or a map that is fitted."""
    config = solved_light(tiny_config())
    fit = dataclasses.replace(config.light.fit, points=512, every=50)
    light = dataclasses.replace(
        config.light,
        kind="distant",
        environment_height=8,
        fit=fit,
        inter_reflection="off",
        map=None if known_map is None else str(known_map),
    )
    return dataclasses.replace(
        config,
        light=light,
        brdf=dataclasses.replace(config.brdf, width=32),
        shading=dataclasses.replace(config.shading, train_samples=32, eval_samples=256),
        loss=dataclasses.replace(config.loss, smoothness=0.0, lambertian=0.0),
        optimizer=dataclasses.replace(config.optimizer, brdf=1e-2),
        train=dataclasses.replace(config.train, sdf_steps=0, material_steps=steps, joint_steps=0),
    )


def batch_of(pixels: Photographed, color: np.ndarray, rows: np.ndarray | slice) -> PixelBatch:
    arrays = (pixels.origins[rows], pixels.directions[rows], color[rows])
    return pixel_batch(*(torch.from_numpy(np.ascontiguousarray(a)).float() for a in arrays))


def learn(
    ball: KnownBall,
    folder: Path,
    steps: int = 200,
    response: str = "linear",
    known_light: bool = True,
    by_lobe: bool = True,
    unit: float = 1.0,
    pose_noise: float = 0.0,
    fireflies: int = 0,
    autocast: bool = False,
    mesh: bool = False,
    paper: bool = False,
) -> Errors:
    """Learn the material of a ball from its pixels, and compare it with the truth.

    Args:
        unit: factor on all radiance, of the images and of the known map.
        pose_noise: standard deviation of the direction of each training ray, radians.
        fireflies: number of training pixels that hold 65504, the largest half-precision number.
        mesh: the ball is a mesh, whose R is trained from the same pixels, and light between its points is
            traced; otherwise it is a host in closed form, and nothing is traced.
        paper: train with `settings_of_paper_ngp`, whose light is a field that is learned.
    """
    torch.manual_seed(0)
    pixels = photograph(ball, PIXELS, seed=0, by_lobe=by_lobe)
    truth = photograph(ball, HELD_BACK, seed=1, by_lobe=by_lobe)
    color = unit * pixels.color
    if response == "srgb":
        color = np.rint(255 * srgb(color)) / 255
    rng = np.random.default_rng(2)
    color[rng.choice(PIXELS, fireflies, replace=False)] = 65504.0
    noisy = pixels.directions + pose_noise * rng.normal(size=(PIXELS, 3))
    noisy /= np.linalg.norm(noisy, axis=-1, keepdims=True)
    pixels = dataclasses.replace(pixels, directions=noisy)
    known_map = folder / "sky.exr" if known_light else None
    if known_map is not None:
        write_exr(known_map, {"RGB": (unit * ball.environment).astype(np.float32)})

    median = float(np.median(unit * pixels.color))
    config = settings_of_paper_ngp(steps, mesh) if paper else settings(steps, known_map)
    if mesh and not paper:
        config = changed(config, {"light.inter_reflection": "hard"})
    host = ball_mesh(median, small_paper_ngp() if paper else tiny_config()) if mesh else closed_form_host
    neilf = attach_neilf(host, config, response=response, median_radiance=median)
    optimizer = torch.optim.Adam(neilf.param_groups())
    neilf.guard(optimizer)
    decay = torch.optim.lr_scheduler.ExponentialLR(optimizer, 0.05 ** (1 / steps))
    for step in range(steps):
        with torch.autocast("cpu", dtype=torch.bfloat16) if autocast else nullcontext():
            loss = neilf.losses(batch_of(pixels, color, rng.integers(PIXELS, size=RAYS)), step).loss
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        decay.step()
    assert neilf.step_guard.skipped == 0
    return errors(neilf, ball, truth, unit)


@torch.no_grad()
def errors(neilf: AttachedNeilf, ball: KnownBall, truth: Photographed, unit: float) -> Errors:
    neilf.eval()
    rays = batch_of(truth, truth.color, slice(None)).rays
    maps, seen = neilf.maps(rays), neilf.model.host.render(rays).color
    values = (maps.base_color, maps.roughness, maps.metallic, maps.rgb / unit, seen / unit)
    return compare(Answer(*(value.double().numpy() for value in values)), ball, truth)


# ------------------------------------------------------------------------------------------------------ cases


def gold(n: Array) -> Array:
    return np.broadcast_to([0.95, 0.7, 0.4], n.shape)


def gray(value: float):
    return lambda n: np.full_like(n, value)


@dataclass(frozen=True)
class Case:
    """A training, and the largest errors that it may end with, by name (`Errors`)."""

    ball: KnownBall
    bounds: Mapping[str, float]
    options: Mapping[str, Any] = field(default_factory=dict)


EVEN = np.ones((16, 32, 3))
PAINT = KnownBall()
PAINT_BOUNDS = {"base_color": 0.012, "roughness": 0.019, "metallic": 0.025, "image": 0.025}
QUICK = {
    "mirror": Case(
        KnownBall(roughness=0.08, metallic=1.0, base_color=gray(0.9)),
        {"base_color": 0.01, "roughness": 0.1, "metallic": 0.02, "image": 0.024},
    ),
    "white on white": Case(
        KnownBall(EVEN, roughness=0.7, base_color=gray(0.9)), {"base_color": 0.038, "image": 0.012}
    ),
    "over-exposed LDR": Case(
        dataclasses.replace(PAINT, environment=3.0 * sky()),
        {"base_color": 0.03, "roughness": 0.025, "metallic": 0.036, "image": 0.08},
        {"response": "srgb"},
    ),
    "sun of 1e5": Case(
        KnownBall(sun(1e5), roughness=0.6),
        {"base_color": 0.022, "roughness": 0.03, "metallic": 0.04, "image": 0.035},
        {"by_lobe": False},
    ),
}
LONG = {
    "paint": Case(PAINT, PAINT_BOUNDS),
    "rough metal": Case(
        KnownBall(roughness=0.6, metallic=1.0, base_color=gold),
        {"scaled_base_color": 0.04, "roughness": 0.047, "metallic": 0.19, "image": 0.06},
    ),
    "soot": Case(
        KnownBall(roughness=0.9, base_color=gray(0.02)),
        {"base_color": 0.014, "roughness": 0.05, "image": 0.048},
    ),
    "black": Case(
        KnownBall(roughness=0.35, base_color=gray(0.0)),
        {"base_color": 0.022, "roughness": 0.023, "image": 0.12},
    ),
    "LDR": Case(
        PAINT,
        {"base_color": 0.01, "roughness": 0.016, "metallic": 0.029, "image": 0.029},
        {"response": "srgb"},
    ),
    "noisy poses": Case(
        PAINT,
        {"base_color": 0.025, "roughness": 0.11, "metallic": 0.056, "image": 0.057},
        {"pose_noise": 0.01},
    ),
    "radiance in units of 1e-4": Case(PAINT, PAINT_BOUNDS, {"unit": 1e4}),
    "radiance in units of 1e4": Case(PAINT, PAINT_BOUNDS, {"unit": 1e-4}),
    "15 fireflies of 65504": Case(PAINT, PAINT_BOUNDS, {"fireflies": 15}),
    "autocast to bfloat16": Case(PAINT, PAINT_BOUNDS, {"autocast": True}),
    "mesh": Case(
        PAINT,
        {"base_color": 0.009, "roughness": 0.013, "metallic": 0.019, "image": 0.025, "radiance": 0.14},
        {"mesh": True},
    ),
    "mesh, LDR": Case(
        PAINT,
        {"base_color": 0.011, "roughness": 0.014, "metallic": 0.028, "image": 0.033, "radiance": 0.14},
        {"mesh": True, "response": "srgb"},
    ),
    "light not known": Case(PAINT, {"scaled_base_color": 0.145, "image": 0.12}, {"known_light": False}),
    # A constant is right here. What fails is a texture of the light or of the material that is not there.
    "white on white, light not known": Case(
        KnownBall(EVEN, roughness=0.7, base_color=gray(0.9)),
        {"scaled_base_color": 0.003, "image": 0.015},
        {"known_light": False},
    ),
}


PAPER = {"paper": True, "steps": 400, "known_light": False}
PAPER_BALL = KnownBall(lobe="spherical_gaussian")
LONG |= {
    "paper-ngp, light not known": Case(
        PAPER_BALL, {"scaled_base_color": 0.085, "roughness": 0.05, "metallic": 0.075, "image": 0.058}, PAPER
    ),
    "paper-ngp, mesh, LDR, autocast, light not known": Case(
        PAPER_BALL,
        {"scaled_base_color": 0.14, "roughness": 0.14, "metallic": 0.042, "image": 0.085, "radiance": 0.14},
        {**PAPER, "mesh": True, "response": "srgb", "autocast": True},
    ),
}

NOT_RECOVERED = [("light not known", "roughness", 0.1)]
"""Cases of `LONG` and bounds that are exceeded, each as large as would be useful."""


def check(found: Errors, bounds: Mapping[str, float]) -> None:
    print(found)  # shown by pytest -rA
    for name, bound in bounds.items():
        assert getattr(found, name) <= bound, f"{name}: {found}"


@cache
def errors_of(name: str) -> Errors:
    """Train a case of `LONG`, once per process, and measure its errors."""
    with TemporaryDirectory() as folder:
        return learn(LONG[name].ball, Path(folder), **LONG[name].options)


@pytest.mark.parametrize("name", QUICK)
def test_recovered_materials_are_accurate(tmp_path, name):
    check(learn(QUICK[name].ball, tmp_path, **QUICK[name].options), QUICK[name].bounds)


@pytest.mark.hard
@pytest.mark.parametrize("name", LONG)
def test_recovered_materials_are_accurate_in_more_cases(name):
    check(errors_of(name), LONG[name].bounds)


@pytest.mark.hard
@pytest.mark.xfail(
    strict=True,
    raises=AssertionError,
    reason="under a light that is not known, paint is found too rough: a constant of 0.5 is better "
    "(docs/stability.md)",
)
@pytest.mark.parametrize(("name", "measure", "bound"), NOT_RECOVERED)
def test_values_that_are_not_recovered(name, measure, bound):
    check(errors_of(name), {measure: bound})


@pytest.mark.hard
@pytest.mark.xfail(
    strict=True,
    reason="the absolute loss of few noisy samples prefers the lobe of a mirror, and below the smallest "
    "roughness of a lobe nothing leads back (docs/stability.md)",
)
def test_polished_metal_is_not_estimated_as_a_mirror(tmp_path):
    polished = KnownBall(roughness=0.2, metallic=1.0, base_color=gold)
    check(learn(polished, tmp_path), {"roughness": 0.1, "image": 0.04})


@pytest.mark.parametrize(
    ("lobe", "roughness", "metallic"),
    [("ggx", 0.08, 1.0), ("ggx", 0.35, 0.0), ("spherical_gaussian", 0.35, 0.0)],
)
def test_shading_agrees_with_the_quadrature(lobe, roughness, metallic):
    """The estimator with the true material and 1024 samples: within 2 % per point and 0.3 % in the mean."""
    torch.manual_seed(0)
    ball = KnownBall(roughness=roughness, metallic=metallic, lobe=lobe)
    truth = photograph(ball, 100, seed=1)
    n, wo, base_color, wanted = (
        torch.from_numpy(a).float()
        for a in (truth.normal, -truth.directions, ball.base_color(truth.normal), truth.color)
    )
    light = EnvironmentLight(16, 1.0)
    light.show(torch.from_numpy(ball.environment).float().permute(2, 0, 1))
    made_of = Material(base_color, torch.full((100, 1), roughness), torch.full((100, 1), metallic))
    drawn = sample_directions(
        Sampling("mis", 1024, LOBES[lobe], stochastic=True), n, wo, made_of, light.technique(n)
    )
    shaded = shade(made_of, n, wo, Incident.of(drawn, light.radiance(n, drawn.wi)), LOBES[lobe]).color
    assert (shaded - wanted).abs().mean() < 0.02 * wanted.mean()
    assert shaded.mean().item() == pytest.approx(wanted.mean().item(), rel=3e-3)
