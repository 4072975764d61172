"""Compare the path tracer of `neilfpp relight` with Mitsuba 3.

    python -m benchmarks.relight
    python -m benchmarks.relight --variant llvm_ad_rgb --width 32 --spp 1024 --reference-spp 16384

The scene is a ball of metal and one of paint in a corner, under a map with a sun, with direct light only and
with six bounces. `error` is the mean |ours − Mitsuba's| over the mean radiance, where Mitsuba's image is
the mean of two; `noise` is the mean difference of those two, and `bias` the difference of the means.
`benchmarks/relit.py` compares trained runs and true materials under another light.
"""

from __future__ import annotations

import math
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import trimesh
import tyro
from jaxtyping import Float
from rich.console import Console
from torch import Tensor

from benchmarks.command import run_benchmark
from benchmarks.measure import hardware
from benchmarks.mitsuba_scene import LitScene, Part, PathSampling, load_mitsuba, render
from neilfpp_method.data.cameras.camera import Camera
from neilfpp_method.relight.film import Budget, render_picture
from neilfpp_method.relight.path_tracer import Scene
from neilfpp_method.relight.sky import Sky
from neilfpp_method.relight.surface import Surface
from neilfpp_method.shading.brdf import SPHERICAL_GAUSSIAN
from neilfpp_method.structures import Material

BOUNCES = 6


@dataclass
class Options:
    """Compare the path tracer with Mitsuba."""

    variant: str = "scalar_rgb"
    """Variant of Mitsuba; llvm_ad_rgb is a hundred times faster and needs LLVM (DRJIT_LIBLLVM_PATH)."""
    width: int = 48
    """Width of the images in pixels; the height is three quarters of it."""
    spp: int = 64
    """Samples per pixel of this package."""
    reference_spp: int | None = None
    """Samples per pixel of Mitsuba; default: the same number."""


@dataclass(frozen=True)
class Agreement:
    """Figures relative to the mean radiance (see the module's docstring), and seconds per image."""

    error: float
    noise: float
    bias: float
    seconds: float
    seconds_of_mitsuba: float


def corner_parts() -> list[Part]:
    """A floor, a wall, and two balls."""
    square = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float)
    faces = [[0, 1, 2], [0, 2, 3]]
    wall = square[:, [0, 2, 1]] + [0, 0.6, 1]
    balls = [trimesh.creation.icosphere(subdivisions=4, radius=0.3) for _ in range(2)]
    balls[0].apply_translation([-0.35, 0, 0.301])
    balls[1].apply_translation([0.35, -0.05, 0.301])
    return [
        Part(trimesh.Trimesh(square, faces, process=False), (0.7, 0.7, 0.7), 0.6, 0.0),
        Part(trimesh.Trimesh(wall, faces, process=False), (0.7, 0.2, 0.1), 0.8, 0.0),
        Part(balls[0], (0.9, 0.7, 0.3), 0.3, 1.0),
        Part(balls[1], (0.2, 0.5, 0.8), 0.4, 0.1),
    ]


def sunny_map(height: int = 32) -> Float[Tensor, "H W 3"]:
    """A sky that becomes darker downwards, with a sun of three texels."""
    sky = torch.linspace(1.0, 0.2, height)[:, None, None].expand(height, 2 * height, 3) * torch.tensor(
        [0.7, 0.9, 1.2]
    )
    sky[height // 5, height : height + 3] = torch.tensor([120.0, 100.0, 70.0])
    return sky.contiguous()


def corner_camera(width: int) -> Camera:
    """A camera in front of the corner and above it."""
    height = round(width * 0.75)
    eye, forward = np.array([0.0, -2.6, 1.3]), np.array([0.0, 2.6, -1.0]) / math.hypot(2.6, 1.0)
    right = np.array([1.0, 0.0, 0.0])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ eye
    return Camera(1.2 * width, 1.2 * width, width / 2, height / 2, width, height, pose)


def scene_of(parts: list[Part], sky: Sky) -> Scene:
    """The parts as a scene of the path tracer: each point has the material of the part on which it lies."""
    triangles = torch.from_numpy(np.concatenate([part.mesh.triangles for part in parts]).astype(np.float32))
    rows = torch.tensor([[*part.base_color, part.roughness, part.metallic] for part in parts])
    centers = torch.tensor([[-0.35, 0.0, 0.301], [0.35, -0.05, 0.301]])

    def materials(x: Float[Tensor, "N 3"]) -> Material:
        number = torch.where(x[:, 2] > 1e-3, 1, 0)
        near = torch.cdist(x, centers) < 0.302
        number = torch.where(near[:, 0], 2, torch.where(near[:, 1], 3, number))
        base_color, roughness, metallic = rows[number].split([3, 1, 1], dim=-1)
        return Material(base_color, roughness, metallic)

    return Scene(Surface(triangles), materials, SPHERICAL_GAUSSIAN, sky)


def agreement(variant: str, width: int, spp: int, reference_spp: int, bounces: int) -> Agreement:
    """Differences between this package's image of the corner and Mitsuba's, and between two images of
    Mitsuba.
    """
    mi = load_mitsuba(variant)
    parts, radiance, camera = corner_parts(), sunny_map(), corner_camera(width)
    begun = time.perf_counter()
    scene = scene_of(parts, Sky(radiance, rows_at_poles=True, start=0.0))
    ours = render_picture(scene, camera, Budget(spp), bounces).radiance.numpy()
    seconds = time.perf_counter() - begun
    with tempfile.TemporaryDirectory() as folder:
        begun = time.perf_counter()
        lit = LitScene(parts, radiance.numpy())
        theirs = [
            render(mi, lit, camera, PathSampling(reference_spp, bounces, seed), Path(folder))
            for seed in (1, 2)
        ]
        seconds_of_mitsuba = (time.perf_counter() - begun) / 2
    reference = (theirs[0] + theirs[1]) / 2
    mean = reference.mean()
    return Agreement(
        float(np.abs(ours - reference).mean() / mean),
        float(np.abs(theirs[1] - theirs[0]).mean() / mean),
        float((ours - reference).mean() / mean),
        seconds,
        seconds_of_mitsuba,
    )


def main(options: Options, console: Console) -> None:
    """Measure, and print."""
    console.print(hardware(), markup=False)
    reference_spp = options.reference_spp or options.spp
    for title, bounces in (("direct", 1), ("six bounces", BOUNCES)):
        found = agreement(options.variant, options.width, options.spp, reference_spp, bounces)
        shares = ", ".join(
            f"{name} {100 * getattr(found, name):.2f} %" for name in ("error", "noise", "bias")
        )
        times = f"{found.seconds:.1f} s, Mitsuba {found.seconds_of_mitsuba:.1f} s"
        console.print(f"{title}: {shares}; {times}", highlight=False)


if __name__ == "__main__":
    run_benchmark(lambda: main(tyro.cli(Options), Console()))
