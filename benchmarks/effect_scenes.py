"""Four small captures with known effects of light, rendered by Mitsuba 3.

    python -m benchmarks.effect_scenes build/effect-scenes --variant llvm_ad_rgb

    lambertian   a convex ball of eight Lambertian paints under a coloured sky with a sun
    lamp         a shiny ball and a dull box on a floor under an even white sky, with a white lamp
    bowl         a bowl with four coloured walls of equal roughness, under a grey sky with a bright window
    polished     a vase of polished metals with a painted foot, under a sky with clouds and a sun

Each is a folder in the layout of the published captures, with its mesh, depth, normals, and materials of the
test views. A Lambertian surface has the roughness 1 there.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
import tyro
from jaxtyping import Float
from rich.console import Console
from scipy import ndimage

from benchmarks.command import run_benchmark
from benchmarks.mitsuba_scene import Lamp, LitScene, Part, PathSampling, load_mitsuba, render
from neilfpp_method.data.cameras.camera import Camera
from neilfpp_method.data.files.images import write_exr, write_png
from neilfpp_method.data.files.json_entry import write_json

__all__ = ["SCENES", "KnownScene", "write_capture"]

DISTANCE = 3.4
"""Distance of the cameras from the centre, world units; the scene box is the unit ball."""
BOUNCES = 6
TEST_EVERY = 6


@dataclass(frozen=True)
class KnownScene:
    """The parts of a scene, its environment map, and the alternating elevations of the cameras in degrees."""

    parts: list[Part]
    radiance: Float[np.ndarray, "H W 3"]
    lamps: tuple[Lamp, ...]
    elevations: tuple[float, float]


def lambertian() -> KnownScene:
    """A ball whose octants are of eight paints."""
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.8)
    octant = (ball.triangles_center > 0) @ np.array([1, 2, 4])
    paints = [(0.2 + 0.5 * (k & 1), 0.2 + 0.25 * (k & 2), 0.2 + 0.12 * (k & 4)) for k in range(8)]
    parts = [
        Part(ball.submesh([np.nonzero(octant == k)[0]], append=True), paint, None, 0.0)
        for k, paint in enumerate(paints)
    ]
    return KnownScene(parts, sky((0.5, 0.8, 1.3), (1.0, 0.9, 0.8), (90.0, 60.0, 30.0)), (), (40.0, -15.0))


def lamp() -> KnownScene:
    """Two objects on a floor, and a lamp between them and the cameras."""
    floor = trimesh.creation.box((1.3, 1.3, 0.04))
    floor.apply_translation((0, 0, -0.32))
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.28)
    ball.apply_translation((-0.25, 0.05, -0.02))
    box = trimesh.creation.box((0.3, 0.3, 0.4))
    box.apply_translation((0.3, 0.15, -0.1))
    parts = [
        Part(floor, (0.5, 0.5, 0.5), 0.7, 0.0),
        Part(ball, (0.7, 0.15, 0.1), 0.25, 0.0),
        Part(box, (0.15, 0.3, 0.6), 0.6, 0.0),
    ]
    bulb = Lamp((0.05, -0.35, 0.35), 0.06, (30.0, 30.0, 30.0))
    return KnownScene(parts, np.full((16, 32, 3), 0.25), (bulb,), (35.0, 60.0))


def bowl() -> KnownScene:
    """Half of a spherical shell, open at the top; each quarter has a colour."""
    turn = np.linspace(0, math.pi / 2, 24)
    inner = np.stack([0.72 * np.sin(turn), -0.72 * np.cos(turn)], 1)
    outer = np.stack([0.8 * np.sin(turn), -0.8 * np.cos(turn)], 1)
    profile = np.concatenate([outer, inner[::-1]])
    profile[[0, -1], 0] = 0
    shell = trimesh.creation.revolve(profile, sections=64)
    shell.apply_translation((0, 0, 0.35))
    center = shell.triangles_center
    quarter = (center[:, 0] > 0) + 2 * (center[:, 1] > 0)
    colors = [(0.75, 0.15, 0.1), (0.15, 0.65, 0.2), (0.15, 0.25, 0.75), (0.7, 0.7, 0.65)]
    parts = [
        Part(shell.submesh([np.nonzero(quarter == k)[0]], append=True), color, 0.3, 0.0)
        for k, color in enumerate(colors)
    ]
    return KnownScene(parts, sky((0.7,) * 3, (0.15,) * 3, (25.0,) * 3), (), (65.0, 40.0))


def polished() -> KnownScene:
    """A vase with a waist, of three metals of roughness 0.15 to 0.3, on a foot of rough paint.

    Neighbouring facets differ by less than a degree, so that reflections do not show them.
    """
    height = np.linspace(-0.75, 0.75, 385)
    waist = 0.33 - 0.16 * np.cos(2.4 * math.pi * (height + 0.75) / 1.5)
    profile = np.concatenate([[[0, -0.75]], np.stack([waist, height], 1), [[0, 0.75]]])
    vase = trimesh.creation.revolve(profile, sections=512)
    level = np.digitize(vase.triangles_center[:, 2], (-0.45, -0.05, 0.35))
    materials = [
        ((0.6, 0.55, 0.45), 0.6, 0.0),
        ((0.95, 0.75, 0.4), 0.15, 1.0),
        ((0.9, 0.9, 0.9), 0.2, 1.0),
        ((0.9, 0.6, 0.5), 0.3, 1.0),
    ]
    parts = [
        Part(vase.submesh([np.nonzero(level == k)[0]], append=True), color, roughness, metallic)
        for k, (color, roughness, metallic) in enumerate(materials)
    ]
    return KnownScene(parts, clouds(), (), (35.0, -5.0))


SCENES: Mapping[str, Callable[[], KnownScene]] = {
    "lambertian": lambertian,
    "lamp": lamp,
    "bowl": bowl,
    "polished": polished,
}


def sky(
    above: tuple[float, ...], below: tuple[float, ...], sun: tuple[float, ...], height: int = 32
) -> Float[np.ndarray, "H W 3"]:
    """A map that varies smoothly from above to below, with a window of 17° near the zenith."""
    share = np.linspace(0, 1, height)[:, None, None]
    radiance = (1 - share) * np.array(above) + share * np.array(below) + np.zeros((height, 2 * height, 3))
    radiance[height // 4 - 1 : height // 4 + 2, height // 2 : height // 2 + 5] = sun
    return radiance


def clouds(height: int = 64) -> Float[np.ndarray, "H W 3"]:
    """A blue sky with a soft sun and white clouds over brown ground. Not random."""
    noise = np.random.default_rng(0).normal(size=(height, 2 * height))
    smooth = ndimage.gaussian_filter(noise, height / 12, mode=("nearest", "wrap"))
    cover = np.clip(3 * smooth / smooth.std(), 0, 1)[..., None]
    radiance = (1 - cover) * sky((0.4, 0.6, 1.0), (0.4, 0.5, 0.6), (0.4, 0.6, 1.0), height) + cover
    radiance[height // 2 :] = 0.5 * radiance[height // 2 :] * np.array([0.6, 0.5, 0.35])
    row, column = np.mgrid[:height, : 2 * height]
    away = ((row - height // 4) ** 2 + (column - height // 2) ** 2) / (height / 16) ** 2
    return radiance + np.exp(-away)[..., None] * np.array([30.0, 26.0, 20.0])


def camera_at(azimuth: float, elevation: float, width: int, height: int) -> Camera:
    """A camera that looks at the centre; angles in radians."""
    outward = np.array(
        [
            math.cos(azimuth) * math.cos(elevation),
            math.sin(azimuth) * math.cos(elevation),
            math.sin(elevation),
        ]
    )
    right = np.cross(-outward, (0, 0, 1))
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(-outward, right), -outward])
    pose[:3, 3] = -pose[:3, :3] @ (DISTANCE * outward)
    focal = 1.6 * height
    return Camera(focal, focal, width / 2, height / 2, width, height, pose)


@dataclass(frozen=True)
class Seen:
    """The hits of a view's pixels, row by row: z-depth (0 without a hit), normal, and index of the part."""

    depth: Float[np.ndarray, "h w"]
    normal: Float[np.ndarray, "h w 3"]
    part: Float[np.ndarray, "h w"]


def look(mesh: trimesh.Trimesh, part_of_face: np.ndarray, camera: Camera) -> Seen:
    """Trace rays through the pixel centres of a camera."""
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    local = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], -1)
    directions = local.reshape(-1, 3) @ camera.w2c[:3, :3]
    origins = np.broadcast_to(-camera.w2c[:3, :3].T @ camera.w2c[:3, 3], directions.shape)
    places, rays, faces = mesh.ray.intersects_location(origins, directions, multiple_hits=False)
    depth, normal, part = np.zeros(u.size), np.zeros((u.size, 3)), np.full(u.size, -1)
    depth[rays] = places @ camera.w2c[2, :3] + camera.w2c[2, 3]
    normal[rays], part[rays] = mesh.face_normals[faces], part_of_face[faces]
    return Seen(depth.reshape(u.shape), normal.reshape(*u.shape, 3), part.reshape(u.shape))


def write_capture(mi, scene: KnownScene, root: Path, views: int, size: tuple[int, int], samples: int) -> Path:
    """Render a scene into a folder; one view in `TEST_EVERY` is a test view. `mi` is the result of
    `load_mitsuba`.
    """
    inputs, (width, height) = root / "inputs", size
    mesh = trimesh.util.concatenate([part.mesh for part in scene.parts])
    part_of_face = np.repeat(range(len(scene.parts)), [len(part.mesh.faces) for part in scene.parts])
    for folder in (inputs / "model", inputs / "images", inputs / "masks"):
        folder.mkdir(parents=True, exist_ok=True)
    mesh.export(inputs / "model" / "mesh.ply")
    rows = np.array(
        [[*p.base_color, 1.0 if p.roughness is None else p.roughness, p.metallic] for p in scene.parts]
    )
    lit = LitScene(scene.parts, scene.radiance, scene.lamps)
    tracks, files, test = {}, {}, []
    for i in range(views):
        elevation = math.radians(scene.elevations[i % 2])
        camera, name = camera_at(2 * math.pi * i / views, elevation, width, height), f"{i:03d}"
        with tempfile.TemporaryDirectory() as folder:
            picture = render(mi, lit, camera, PathSampling(samples, BOUNCES, seed=i), Path(folder))
        seen = look(mesh, part_of_face, camera)
        write_exr(inputs / "images" / f"{name}.exr", {"RGB": picture.astype(np.float32)})
        write_exr(inputs / "depth_maps" / f"{name}.exr", {"Y": seen.depth.astype(np.float32)})
        write_exr(inputs / "normal_maps" / f"{name}.exr", {"RGB": seen.normal.astype(np.float32)})
        write_png(inputs / "masks" / f"{name}.png", np.where(seen.part >= 0, 255, 0).astype(np.uint8))
        if i % TEST_EVERY == 0:
            test.append(name)
            shown = np.where(seen.part[..., None] >= 0, rows[seen.part], 0)
            for kind, part in (("kd", slice(3)), ("roughness", 3), ("metallic", 4)):
                path = root / "ground_truths" / "materials" / kind / f"{name}.png"
                write_png(path, np.rint(255 * shown[..., part]).astype(np.uint8))
        intrinsic = {"focal": [camera.fx, camera.fy], "ppt": [camera.cx, camera.cy]}
        extrinsic = camera.w2c.reshape(-1).tolist()
        tracks[str(i)] = {
            "flg": 2,
            "size": [width, height],
            "camera": {"intrinsic": intrinsic, "extrinsic": extrinsic},
        }
        files[str(i)] = f"images/{name}.exr"
    box = np.diag([2.0, 2.0, 2.0, 1.0]).reshape(-1).tolist()
    write_json(root / "split.json", {"test": test})
    write_json(
        inputs / "sfm_scene.json",
        {
            "camera_track_map": {"images": tracks},
            "image_path": {"file_paths": files},
            "bbox": {"transform": box},
        },
    )
    write_exr(root / "light" / "envmap.exr", {"RGB": scene.radiance.astype(np.float32)})
    return root


@dataclass
class Options:
    """Render the captures."""

    out: tyro.conf.Positional[Path]
    """Output folder; each scene is a sub-folder."""
    variant: str = "scalar_rgb"
    """Variant of Mitsuba; llvm_ad_rgb is a hundred times faster and needs LLVM (DRJIT_LIBLLVM_PATH)."""
    views: int = 24
    """Number of views of each scene; one in six is a test view."""
    width: int = 96
    """Width of the images in pixels; the height is three quarters of it."""
    samples: int = 256
    """Samples per pixel."""


def main(options: Options, console: Console) -> None:
    """Write the captures that do not exist yet."""
    mi = load_mitsuba(options.variant)
    for name, scene in SCENES.items():
        root = options.out / name
        if (root / "split.json").exists():
            console.print(f"{root} exists already", soft_wrap=True)
            continue
        size = (options.width, round(0.75 * options.width))
        console.print(
            f"{write_capture(mi, scene(), root, options.views, size, options.samples)}", soft_wrap=True
        )


if __name__ == "__main__":
    run_benchmark(lambda: main(tyro.cli(Options), Console()))
