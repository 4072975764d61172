"""Whole trainings, as `neilfpp train` runs them, on captures with a known truth.

Geometry starts from the visual hull, and nothing but images, masks and cameras is given: surface, material
and light are recovered together. The images are made by quadrature or exact distances, apart from the
package. Bounds are about 1.5 times the larger error of two seeds, at rays of other views.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from rich.console import Console

from neilfpp_method.effects import review
from neilfpp_method.effects.request import EffectRequest
from neilfpp_method.kernels.process import computing_fast
from neilfpp_method.settings.plain import changed
from neilfpp_method.settings.presets import preset
from neilfpp_method.structures import RayBatch
from neilfpp_method.train.command import run_training
from neilfpp_method.train.request import TrainingRequest
from neilfpp_method.train.run import Run, load_run
from tests.hard_cases import known_shapes as shapes
from tests.hard_cases.known_ball import RADIUS, KnownBall, photograph
from tests.hard_cases.known_capture import Look, look_at_ball, look_at_shape, write_capture
from tests.hard_cases.test_known_materials import gray
from tests.hard_cases.test_known_shapes import Errors as SurfaceErrors
from tests.hard_cases.test_known_shapes import errors as surface_errors

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
    "volume.samples": 24,
    "shading.train_samples": 32,
    "train.sdf_steps": 250,
    "train.material_steps": 250,
    "train.joint_steps": 30,
    "train.rays": 128,
}
"""Differences from the preset `fast`: smaller fields, fewer rays and steps."""

SURFACE_ONLY = {"train.sdf_steps": 400, "train.rays": 192, "train.material_steps": 0, "train.joint_steps": 0}
"""Differences from `SMALLER` for shapes whose material is not compared."""


def trained(
    look: Look,
    folder: Path,
    hdr: bool = True,
    changes: Mapping[str, object] | None = None,
    **capture: Any,
) -> Run:
    """Write a capture, train it as `neilfpp train` does, and load the run.

    Poses and exposures are not corrected, as `--effects auto` decides here; the evidence for the other
    effects is not measured, which would take minutes. `capture` are options of `write_capture`.
    """
    root = write_capture(folder / "capture", look, hdr=hdr, **capture)
    config = changed(preset("fast"), {**SMALLER, **(changes or {})})
    effects = EffectRequest("as-set", {"poses": False, "exposure": False})
    request = TrainingRequest(data=root, out=folder / "run", config=config, effects=effects, device="cpu")
    with pytest.MonkeyPatch.context() as patch, computing_fast():
        patch.setattr(review, "PLACES", PLACES)
        return load_run(run_training(request, Console(width=160)))


@dataclass(frozen=True)
class Errors:
    """Errors at rays of other views.

    Attributes:
        outline, normal, position: as in `test_known_shapes`.
        base_color: mean absolute error after the best factor per channel, since the light is not known.
        roughness, metallic: mean absolute errors.
        image: mean absolute error of the shaded radiance over the mean radiance.
        radiance: the same of the volume-rendered radiance.
    """

    outline: float
    normal: float
    position: float
    base_color: float
    roughness: float
    metallic: float
    image: float
    radiance: float


@torch.no_grad()
def errors(run: Run, ball: KnownBall) -> Errors:
    surface = surface_errors(run.model, shapes.photograph(lambda x: shapes.ball(x, RADIUS), 2000, 40, seed=1))
    truth = photograph(ball, HELD_BACK, seed=1)
    rays = RayBatch(*(torch.from_numpy(a).float() for a in (truth.origins, truth.directions)))
    color, maps = run.model.host.render(rays).color.double().numpy(), run.model.maps(rays)
    found, wanted = maps.base_color.double().numpy(), ball.base_color(truth.normal)
    scale = (found * wanted).sum(0) / (found**2).sum(0)
    mean = truth.color.mean()
    return Errors(
        outline=surface.outline,
        normal=surface.normal,
        position=surface.position,
        base_color=float(np.abs(scale * found - wanted).mean()),
        roughness=float((maps.roughness - ball.roughness).abs().mean()),
        metallic=float((maps.metallic - ball.metallic).abs().mean()),
        image=float(np.abs(maps.rgb.double().numpy() - truth.color).mean() / mean),
        radiance=float(np.abs(color - truth.color).mean() / mean),
    )


# ------------------------------------------------------------------------------------------------------ cases


@dataclass(frozen=True)
class Case:
    """A training, and the largest errors that it may end with, by name (`Errors`)."""

    ball: KnownBall
    bounds: Mapping[str, float]
    hdr: bool = True


PAINT = KnownBall()
MIRROR = KnownBall(roughness=0.08, metallic=1.0, base_color=gray(0.9))
CASES = {
    "paint": Case(
        PAINT,
        {
            "outline": 0.038,
            "normal": 15.0,
            "position": 0.04,
            "base_color": 0.12,
            "roughness": 0.065,
            "metallic": 0.075,
            "image": 0.13,
            "radiance": 0.16,
        },
    ),
    # The roughness is not recovered: the highlight is over-exposed (docs/stability.md).
    "paint, LDR": Case(
        PAINT,
        {
            "outline": 0.038,
            "normal": 15.0,
            "position": 0.036,
            "base_color": 0.17,
            "metallic": 0.075,
            "image": 0.13,
            "radiance": 0.18,
        },
        hdr=False,
    ),
    # It is recovered as a blurred mirror, a half metal (docs/stability.md).
    "mirror": Case(
        MIRROR,
        {
            "outline": 0.042,
            "normal": 12.0,
            "position": 0.035,
            "base_color": 0.16,
            "roughness": 0.42,
            "metallic": 0.63,
            "image": 0.46,
            "radiance": 0.45,
        },
    ),
}


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
    "thin plate": SurfaceErrors(outline=0.056, normal=16.0, position=0.03, color=0.0075),
    "wire": SurfaceErrors(outline=0.26, normal=21.5, position=0.012, color=0.0033),
}

WITHOUT_OUTLINE = {
    "cube": WithoutOutline(SurfaceErrors(outline=0.001, normal=6.0, position=0.006, color=0.018), frame=0.7),
    "room": WithoutOutline(SurfaceErrors(outline=0.001, normal=4.5, position=0.006, color=0.01), inside=True),
}


def check(found: Errors | SurfaceErrors, bounds: Mapping[str, float]) -> None:
    print(found)  # shown by pytest -rA
    for name, bound in bounds.items():
        assert getattr(found, name) <= bound, f"{name}: {found}"


@pytest.mark.parametrize("name", CASES)
def test_surface_material_and_light_are_recovered_together(tmp_path, name):
    case = CASES[name]
    check(errors(trained(look_at_ball(case.ball), tmp_path, case.hdr), case.ball), case.bounds)


@pytest.mark.parametrize("name", THIN)
def test_a_thin_shape_is_recovered_from_its_hull(tmp_path, name):
    shape = shapes.SHAPES[name]
    run = trained(look_at_shape(shape), tmp_path, changes=SURFACE_ONLY)
    truth = shapes.photograph(shape, 2000, views=40, seed=1)
    check(surface_errors(run.model, truth), asdict(THIN[name]))


@pytest.mark.parametrize("name", WITHOUT_OUTLINE)
def test_a_shape_that_fills_every_image_is_recovered_with_its_cloud(tmp_path, name):
    shape, case = shapes.SHAPES[name], WITHOUT_OUTLINE[name]
    cloud = shapes.photograph(shape, 2000, seed=0, **case.camera)
    changes = {**SURFACE_ONLY, "loss.point_cloud": 1.0}
    run = trained(look_at_shape(shape), tmp_path, changes=changes, cloud=cloud, **case.camera)
    truth = shapes.photograph(shape, 2000, seed=1, **{**case.camera, "views": 40})
    check(surface_errors(run.model, truth), asdict(case.largest))
