"""The path tracer of `neilfpp relight` against Mitsuba 3, and against pictures of a capture under another
light.

    python -m benchmarks.relight
    python -m benchmarks.relight --variant llvm_ad_rgb --width 160 --spp 1024
    python -m benchmarks.relight --capture DATA/tabletop_env --under DATA/tabletop_relight

Without a capture: a ball of metal and one of paint in a corner, under a map with a sun, direct light alone
    and with six
bounces. `mean error` is the mean |ours − Mitsuba's| over the mean radiance, `noise` that of two pictures by
Mitsuba itself with other random numbers, `bias` the difference of the means.

With a capture: its mesh, and the true material of its test views, carried to all points by the nearest pixel,
    under
`<under>/envmap.exr`; PSNR against `<under>/images`. What is missing to perfect is the tracer's own error and
the noise.
"""

from __future__ import annotations

import math
import sys
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
from scipy.spatial import cKDTree
from torch import Tensor

from benchmarks.measure import hardware
from benchmarks.mitsuba_scene import Part, load_mitsuba, render
from neilfpp_method.data.capture import Capture, load_capture
from neilfpp_method.data.mesh import Mesh
from neilfpp_method.data.truth import Truth
from neilfpp_method.data.views import Camera, camera_rays
from neilfpp_method.errors import UserError
from neilfpp_method.hosts.mesh import MeshHost
from neilfpp_method.relight.comparison import compare, find_truth, read_truth
from neilfpp_method.relight.film import Budget, take_picture
from neilfpp_method.relight.maps import read_map
from neilfpp_method.relight.path_tracer import Scene
from neilfpp_method.relight.sky import Sky
from neilfpp_method.relight.surface import Surface
from neilfpp_method.settings.types import NeilfConfig
from neilfpp_method.shading.brdf import SPHERICAL_GAUSSIAN
from neilfpp_method.structures import Material

BOUNCES = 6


@dataclass
class Options:
    """Compare the path tracer with Mitsuba, or with true pictures under another light."""

    variant: str = "scalar_rgb"
    """Of Mitsuba; llvm_ad_rgb is a hundred times faster, and needs LLVM (DRJIT_LIBLLVM_PATH)."""
    width: int = 48
    """Pixels; the height is three quarters of it."""
    spp: int = 64
    """Samples of a pixel, ours and Mitsuba's."""
    capture: Path | None = None
    """A capture with a mesh and with true materials of its test views."""
    under: Path | None = None
    """Its test views under another light: envmap.exr, and images/."""


@dataclass(frozen=True)
class Agreement:
    """Shares of the mean radiance; see above. Seconds are of one picture each."""

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
    """A sky that darkens downwards, with a sun of three texels."""
    sky = torch.linspace(1.0, 0.2, height)[:, None, None].expand(height, 2 * height, 3) * torch.tensor(
        [0.7, 0.9, 1.2]
    )
    sky[height // 5, height : height + 3] = torch.tensor([120.0, 100.0, 70.0])
    return sky.contiguous()


def corner_camera(width: int) -> Camera:
    """From the front and above."""
    height = round(width * 0.75)
    eye, forward = np.array([0.0, -2.6, 1.3]), np.array([0.0, 2.6, -1.0]) / math.hypot(2.6, 1.0)
    right = np.array([1.0, 0.0, 0.0])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ eye
    return Camera(1.2 * width, 1.2 * width, width / 2, height / 2, width, height, pose)


def scene_of(parts: list[Part], sky: Sky) -> Scene:
    """The parts as the path tracer takes them: each point has the material of the part that it lies on."""
    triangles = torch.from_numpy(np.concatenate([part.mesh.triangles for part in parts]).astype(np.float32))
    rows = torch.tensor([[*part.base_color, part.roughness, part.metallic] for part in parts])
    centres = torch.tensor([[-0.35, 0.0, 0.301], [0.35, -0.05, 0.301]])

    def materials(x: Float[Tensor, "N 3"]) -> Material:
        number = torch.where(x[:, 2] > 1e-3, 1, 0)
        near = torch.cdist(x, centres) < 0.302
        number = torch.where(near[:, 0], 2, torch.where(near[:, 1], 3, number))
        base_color, roughness, metallic = rows[number].split([3, 1, 1], dim=-1)
        return Material(base_color, roughness, metallic)

    return Scene(Surface(triangles), materials, SPHERICAL_GAUSSIAN, sky)


def agreement(variant: str, width: int, spp: int, bounces: int) -> Agreement:
    """How far our picture of the corner is from Mitsuba's, and Mitsuba's from another one of its own."""
    mi = load_mitsuba(variant)
    parts, radiance, camera = corner_parts(), sunny_map(), corner_camera(width)
    begun = time.perf_counter()
    scene = scene_of(parts, Sky(radiance, rows_at_poles=True, start=0.0))
    ours = take_picture(scene, camera, Budget(spp), bounces).radiance.numpy()
    seconds = time.perf_counter() - begun
    with tempfile.TemporaryDirectory() as folder:
        begun = time.perf_counter()
        theirs = [
            render(mi, parts, radiance.numpy(), camera, Path(folder), spp, bounces, seed) for seed in (1, 2)
        ]
        seconds_of_mitsuba = (time.perf_counter() - begun) / 2
    mean = theirs[0].mean()
    return Agreement(
        float(np.abs(ours - theirs[0]).mean() / mean),
        float(np.abs(theirs[1] - theirs[0]).mean() / mean),
        float((ours - (theirs[0] + theirs[1]) / 2).mean() / mean),
        seconds,
        seconds_of_mitsuba,
    )


# ---------------------------------------------------------------------------------------- under another light


def true_materials(capture: Capture):
    """The material of any point: that of the nearest one that a test view shows.

    Raises:
        UserError: the capture has no true depth and materials.
    """
    truth, places, values = Truth(capture), [], []
    for view in capture.test_views:
        depth, material = truth.depth(view), truth.material(view)
        if depth is None or material is None:
            raise UserError(f"{capture.root}: no true materials", "take a capture with ground truth")
        camera = capture.normalisation.camera(view.camera)
        rays, shown = camera_rays(camera), depth > 0
        along = rays.directions @ torch.as_tensor(camera.w2c[2, :3], dtype=torch.float32)
        places.append((rays.origins + rays.directions * (depth / along)[:, None])[shown])
        values.append(torch.cat([material.base_color, material.roughness, material.metallic], -1)[shown])
    tree, rows = cKDTree(torch.cat(places).numpy()), torch.cat(values)

    def materials(x: Float[Tensor, "N 3"]) -> Material:
        return Material(*rows[torch.from_numpy(tree.query(x.numpy())[1])].split([3, 1, 1], dim=-1))

    return materials


def true_surface(capture: Capture) -> Surface:
    """The mesh of a capture with the normals that the mesh host gives it.

    Raises:
        UserError: the capture has none.
    """
    mesh: Mesh | None = Truth(capture).mesh()
    if mesh is None:
        raise UserError(f"{capture.root}: no inputs/model/mesh.ply", "take a capture with its mesh")
    host = MeshHost(mesh, NeilfConfig(), radiance_scale=1.0)
    return Surface(host.triangles, host.corner_normals)


def relit_truth(options: Options, console: Console) -> None:
    """Print how far the test views are from true pictures under another light."""
    capture = load_capture(options.capture)
    read = read_map(options.under / "envmap.exr", "ours")
    files = find_truth(options.under / "images", capture.test_views)
    scene = Scene(true_surface(capture), true_materials(capture), SPHERICAL_GAUSSIAN, read.sky)
    relit, truths = [], []
    for view in capture.test_views:
        relit.append(
            take_picture(scene, capture.normalisation.camera(view.camera), Budget(options.spp), BOUNCES)
        )
        truths.append(read_truth(capture, view, files[view.name]))
    found = compare([p.radiance.numpy() for p in relit], [p.alpha[..., 0].numpy() for p in relit], truths)
    for name, value in found.figures.items():
        console.print(f"{name:30} {value:7.3f}", highlight=False)
    console.print("scale " + ", ".join(f"{factor:.4f}" for factor in found.scale), highlight=False)


def main(options: Options, console: Console) -> None:
    """Measure, and print."""
    console.print(hardware(), markup=False)
    if (options.capture is None) != (options.under is None):
        raise UserError(
            "--capture and --under go together", "give both, or none for the comparison with Mitsuba"
        )
    if options.capture is not None:
        relit_truth(options, console)
        return
    for title, bounces in (("direct", 1), ("six bounces", BOUNCES)):
        found = agreement(options.variant, options.width, options.spp, bounces)
        shares = ", ".join(
            f"{name} {100 * getattr(found, name):.2f} %" for name in ("error", "noise", "bias")
        )
        times = f"{found.seconds:.1f} s, Mitsuba {found.seconds_of_mitsuba:.1f} s"
        console.print(f"{title}: {shares}; {times}", highlight=False)


if __name__ == "__main__":
    try:
        main(tyro.cli(Options), Console())
    except UserError as error:
        Console(stderr=True).print(f"error: {error}", markup=False)
        sys.exit(error.status)
