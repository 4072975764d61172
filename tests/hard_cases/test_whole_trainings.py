"""Whole trainings, as `neilfpp train` runs them, on captures with a known truth.

Geometry starts from the visual hull, and nothing but images, masks and cameras is given: surface, material
and light are recovered together. The images are made by quadrature or exact distances, apart from the
package. Bounds are about 1.5 times the error of one seed or the larger error of two, at rays of other views,
and below the errors of constant answers (`test_degenerate_answers`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from rich.console import Console

from neilfpp_method.data.files.images import write_exr
from neilfpp_method.effects import review
from neilfpp_method.effects.request import EffectRequest
from neilfpp_method.kernels.process import computing_fast
from neilfpp_method.settings.plain import changed
from neilfpp_method.settings.presets import preset
from neilfpp_method.settings.types import NeilfConfig
from neilfpp_method.structures import RayBatch
from neilfpp_method.train.command import run_training
from neilfpp_method.train.request import TrainingRequest
from neilfpp_method.train.run import Run, load_run
from tests.hard_cases import known_shapes as shapes
from tests.hard_cases.known_ball import RADIUS, Array, KnownBall, photograph
from tests.hard_cases.known_capture import Look, look_at_ball, look_at_shape, write_capture
from tests.hard_cases.material_errors import Answer
from tests.hard_cases.material_errors import Errors as MaterialErrors
from tests.hard_cases.material_errors import compare as compare_material
from tests.hard_cases.shape_errors import Errors as SurfaceErrors
from tests.hard_cases.shape_errors import compare, rays_on_part
from tests.hard_cases.small_presets import small_mesh, small_paper_ngp
from tests.hard_cases.test_known_materials import gold, gray
from tests.hard_cases.test_known_shapes import look

pytestmark = [pytest.mark.hard, pytest.mark.usefixtures("without_shape_checks")]

HELD_BACK = 600
"""Rays at which errors are measured."""
PLACES = 120
"""Places for the initial light, instead of 1200: a fit to these takes a minute on one core."""
SMALLER = {
    "host.sdf.width": 32,
    "encoding.levels": 6,
    "encoding.log2_entries": 13,
    "encoding.sdf_log2_entries": 13,
    "encoding.max_resolution": 64,
    "radiance.width": 32,
    "brdf.width": 32,
    "light.environment_height": 16,
    "light.fit.points": 512,
    "light.fit.every": 50,
    "host.volume.samples": 24,
    "shading.train_samples": 32,
    "train.sdf_steps": 250,
    "train.material_steps": 250,
    "train.joint_steps": 30,
    "train.rays": 128,
}
"""Differences from the preset `fast`: smaller fields, fewer rays and steps."""

PAPER = {
    "host.volume.samples": 24,
    "shading.train_samples": 96,
    "train.sdf_steps": 300,
    "train.material_steps": 400,
    "train.joint_steps": 30,
    "train.rays": 128,
}
"""Differences from `small_paper_ngp`: fewer samples per ray and point, rays and steps."""

SURFACE_ONLY = {"train.sdf_steps": 400, "train.rays": 192, "train.material_steps": 0, "train.joint_steps": 0}
"""Differences from `SMALLER` for shapes whose material is not compared."""


def small_fast() -> NeilfConfig:
    return changed(preset("fast"), SMALLER)


def trained(
    look: Look,
    folder: Path,
    hdr: bool = True,
    config: NeilfConfig | None = None,
    changes: Mapping[str, object] | None = None,
    exposure: bool = False,
    known_map: Array | None = None,
    **capture: Any,
) -> Run:
    """Write a capture, train it as `neilfpp train` does, and load the run.

    Poses are not corrected, and exposures only if that is asked for, as `--effects auto` decides here; the
    evidence for the other effects is not measured, which would take minutes. `config` are the settings; if
    None, `fast` with `SMALLER`. `known_map` is the light if it is given, (H, W, 3). `capture` are options of
    `write_capture`.
    """
    root = write_capture(folder / "capture", look, hdr=hdr, **capture)
    config = changed(config or small_fast(), changes or {})
    if known_map is not None:
        write_exr(folder / "sky.exr", {"RGB": known_map.astype(np.float32)})
        config = changed(config, {"light.map": str(folder / "sky.exr")})
    # On a mesh poses are never corrected.
    poses = {} if config.host.kind == "mesh" else {"poses": False}
    effects = EffectRequest("as-set", {**poses, "exposure": exposure})
    request = TrainingRequest(data=root, out=folder / "run", config=config, effects=effects, device="cpu")
    with pytest.MonkeyPatch.context() as patch, computing_fast():
        patch.setattr(review, "PLACES", PLACES)
        return load_run(run_training(request, Console(width=160)))


@torch.no_grad()
def errors(run: Run, ball: KnownBall) -> tuple[SurfaceErrors, MaterialErrors]:
    """Errors at rays of other views. `radiance` is the volume-rendered one."""
    surface = compare(look(run.model), shapes.photograph(lambda x: shapes.ball(x, RADIUS), 2000, 40, seed=1))
    truth = photograph(ball, HELD_BACK, seed=1)
    rays = RayBatch(*(torch.from_numpy(a).float() for a in (truth.origins, truth.directions)))
    color, maps = run.model.host.render(rays).color, run.model.maps(rays)
    values = (maps.base_color, maps.roughness, maps.metallic, maps.rgb, color)
    material = compare_material(Answer(*(value.double().numpy() for value in values)), ball, truth)
    return surface, material


# ------------------------------------------------------------------------------------------------------ cases


@dataclass(frozen=True)
class Case:
    """A training, and the largest errors that it may end with, by name (of surface and material)."""

    ball: KnownBall
    bounds: Mapping[str, float]
    options: Mapping[str, Any] = field(default_factory=dict)
    """Options of `trained`."""


PAINT = KnownBall()
POLISHED = KnownBall(roughness=0.2, metallic=1.0, base_color=gold)
MIRROR = KnownBall(roughness=0.08, metallic=1.0, base_color=gray(0.9))
PAINT_BOUNDS = {
    "outline": 0.038,
    "normal": 15.0,
    "position": 0.04,
    "scaled_base_color": 0.12,
    "roughness": 0.065,
    "metallic": 0.075,
    "image": 0.13,
    "radiance": 0.16,
}
ON_MESH = {"outline": 0.01, "normal": 0.1, "position": 0.0013}
"""Bounds on the surface if it is given: the triangles lie 0.0009 inside the ball."""
AWAY = (6e3, 0.0, -8e3)
"""The centre of a scene 10⁴ radii from the origin of its world, scene units."""
BALL = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS)
CLOUD = shapes.photograph(lambda x: shapes.ball(x, RADIUS), 2000, seed=0)
HALF_STOPS = 2.0 ** (0.5 * (-1.0) ** np.arange(20))
"""Gains of views that are exposed half a stop too long and too short in turn."""
CASES = {
    "paint": Case(PAINT, PAINT_BOUNDS),
    "paint, world in units of 1e-4, far away": Case(PAINT, PAINT_BOUNDS, {"unit": 1e4, "away": AWAY}),
    "paint, world in units of 1e4, far away": Case(PAINT, PAINT_BOUNDS, {"unit": 1e-4, "away": AWAY}),
    "paint, exposures of ± ½ EV, with a cloud": Case(
        PAINT,
        {**PAINT_BOUNDS, "scaled_base_color": 0.13, "roughness": 0.11},
        {"gains": HALF_STOPS, "exposure": True, "cloud": CLOUD},
    ),
    # Without a cloud the gains are not measured before the training (`NOT_RECOVERED`).
    "paint, exposures of ± ½ EV": Case(
        PAINT,
        {
            "outline": 0.05,
            "normal": 20.0,
            "position": 0.048,
            "metallic": 0.24,
            "image": 0.33,
            "radiance": 0.3,
        },
        {"gains": HALF_STOPS, "exposure": True},
    ),
    # The roughness is not recovered (`NOT_RECOVERED`): the highlight is over-exposed (docs/stability.md).
    "paint, LDR": Case(
        PAINT,
        {
            "outline": 0.038,
            "normal": 15.0,
            "position": 0.036,
            "scaled_base_color": 0.14,
            "metallic": 0.075,
            "image": 0.13,
            "radiance": 0.18,
        },
        {"hdr": False},
    ),
    "paint, paper-ngp, LDR, with a cloud": Case(
        dataclasses.replace(PAINT, lobe="spherical_gaussian"),
        {
            "outline": 0.045,
            "normal": 9.0,
            "position": 0.035,
            "scaled_base_color": 0.13,
            "roughness": 0.13,
            "metallic": 0.06,
            "image": 0.12,
            "radiance": 0.23,
        },
        {"config": changed(small_paper_ngp(), PAPER), "hdr": False, "cloud": CLOUD},
    ),
    "polished metal, mesh": Case(
        POLISHED,
        {
            **ON_MESH,
            "scaled_base_color": 0.05,
            "roughness": 0.1,
            "metallic": 0.05,
            "image": 0.1,
            "radiance": 0.55,
        },
        {"config": small_mesh(small_fast()), "changes": {"train.material_steps": 1000}, "mesh": BALL},
    ),
    # Two of three seeds find a mirror (docs/stability.md), so the roughness has no bound.
    "polished metal, mesh, known map": Case(
        POLISHED,
        {**ON_MESH, "scaled_base_color": 0.06, "metallic": 0.11, "image": 0.14},
        {"config": small_mesh(small_fast()), "mesh": BALL, "known_map": POLISHED.environment},
    ),
    "mirror": Case(
        MIRROR,
        {
            "outline": 0.042,
            "normal": 12.0,
            "position": 0.035,
            "scaled_base_color": 0.08,
            "roughness": 0.11,
            "metallic": 0.27,
            "image": 0.38,
            "radiance": 0.45,
        },
    ),
}
NOT_RECOVERED = [
    ("paint, exposures of ± ½ EV", "scaled_base_color", 0.12),
    ("paint, exposures of ± ½ EV", "roughness", 0.1),
    ("paint, LDR", "roughness", 0.1),
    ("mirror", "image", 0.1),
]
"""Bounds that are exceeded, each as large as would be useful."""


@dataclass(frozen=True)
class WithoutOutline:
    """A shape that fills every image, so that only its point cloud limits it, and the largest errors."""

    largest: SurfaceErrors
    frame: float = 2.0
    inside: bool = False

    @property
    def camera(self) -> dict[str, Any]:
        """Options of `known_shapes.photograph` and of `write_capture`."""
        return {"views": 24, "frame": self.frame, "inside": self.inside}


THIN = {
    "thin plate": SurfaceErrors(0.056, 16.0, 0.03, 0.0075, missed=0.17, detail=0.015),
    "wire": SurfaceErrors(0.26, 21.5, 0.0135, 0.0033, missed=0.1, detail=0.013),
}

WITHOUT_OUTLINE = {
    "cube": WithoutOutline(SurfaceErrors(outline=0.001, normal=6.0, position=0.006, color=0.018), frame=0.7),
    "room": WithoutOutline(SurfaceErrors(outline=0.001, normal=4.5, position=0.006, color=0.01), inside=True),
}


def check(found: Iterable[SurfaceErrors | MaterialErrors], bounds: Mapping[str, float]) -> None:
    print(*found)  # shown by pytest -rA
    values = {name: value for errors in found for name, value in asdict(errors).items()}
    for name, bound in bounds.items():
        assert values[name] <= bound, f"{name}: {found}"


@cache
def errors_of(name: str) -> tuple[SurfaceErrors, MaterialErrors]:
    """Train a case, once per process, and measure its errors."""
    case = CASES[name]
    with TemporaryDirectory() as folder:
        return errors(trained(look_at_ball(case.ball), Path(folder), **case.options), case.ball)


@pytest.mark.parametrize("name", CASES)
def test_surface_material_and_light_are_recovered_together(name):
    check(errors_of(name), CASES[name].bounds)


@pytest.mark.xfail(
    strict=True,
    raises=AssertionError,
    reason="an over-exposed highlight hides the roughness, the reflections of a recovered mirror are not "
    "sharp, and gains that are not measured at a cloud are hardly learned (docs/stability.md)",
)
@pytest.mark.parametrize(("name", "measure", "bound"), NOT_RECOVERED)
def test_values_that_are_not_recovered(name, measure, bound):
    check(errors_of(name), {measure: bound})


@pytest.mark.parametrize("name", THIN)
def test_a_thin_shape_is_recovered_from_its_hull(tmp_path, name):
    shape = shapes.SHAPES[name]
    run = trained(look_at_shape(shape), tmp_path, changes=SURFACE_ONLY)
    truth = shapes.photograph(shape, 2000, views=40, seed=1)
    check([compare(look(run.model), truth, rays_on_part(name))], asdict(THIN[name]))


@pytest.mark.xfail(
    strict=True,
    raises=AssertionError,
    reason="the hull of a bowl is solid, and its inside is not carved out (docs/stability.md)",
)
def test_the_inside_of_a_bowl_is_recovered_from_its_hull(tmp_path):
    run = trained(look_at_shape(shapes.bowl), tmp_path, changes={**SURFACE_ONLY, "train.sdf_steps": 1600})
    truth = shapes.photograph(shapes.bowl, 2000, views=40, seed=1)
    found = compare(look(run.model), truth, rays_on_part("concave bowl"))
    check([found], {"missed": 0.05, "detail": 0.08})


@pytest.mark.parametrize("name", WITHOUT_OUTLINE)
def test_a_shape_that_fills_every_image_is_recovered_with_its_cloud(tmp_path, name):
    shape, case = shapes.SHAPES[name], WITHOUT_OUTLINE[name]
    cloud = shapes.photograph(shape, 2000, seed=0, **case.camera)
    changes = {**SURFACE_ONLY, "host.loss.point_cloud": 1.0}
    run = trained(look_at_shape(shape), tmp_path, changes=changes, cloud=cloud, masks=False, **case.camera)
    truth = shapes.photograph(shape, 2000, seed=1, **{**case.camera, "views": 40})
    check([compare(look(run.model), truth)], asdict(case.largest))
