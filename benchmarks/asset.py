"""Compare the textures of exported assets with the material of their runs.

    python -m benchmarks.asset RUN RUN --texture-size 2048
    python -m benchmarks.asset RUN --sheet docs/assets.png

Each run is exported by `neilfpp export --what asset`. Random points of `asset.glb` are looked up in its
textures, bilinearly, as a renderer does it, and compared with the field of the run there, in values of 0 to
255. Base colour is compared as displayed.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import trimesh
import tyro
from jaxtyping import Float, UInt8
from PIL import Image
from rich.console import Console
from scipy.ndimage import map_coordinates

from benchmarks.command import run_benchmark
from benchmarks.measure import hardware
from neilfpp_method.commands.command import progress_bar
from neilfpp_method.data.files.images import write_png
from neilfpp_method.export.asset.command import AssetOptions, check_asset, export_asset
from neilfpp_method.export.asset.glb import WORLD_TO_GLTF
from neilfpp_method.export.mesh import materials_in_parts
from neilfpp_method.shading.color import tone_map
from neilfpp_method.train.run import Run, load_run

__all__ = ["Agreement", "GlbPoints", "agreement", "field_values", "random_points", "sheet"]

CLOSE = 2.0
"""Largest difference, of 255, that counts as agreement: half a step of rounding, and interpolation."""
SEED = 1
NAMES = ("base colour", "roughness", "metallic")
SHEET = ("base_color", "roughness", "metallic", "normal")
TILE = 192
"""Width of a texture on the sheet, pixels."""


@dataclass
class Options:
    """Export assets, and compare their textures with the runs."""

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Runs with a surface and a material."""
    texture_size: int = 2048
    """Width and height of the textures, in texels."""
    resolution: int = 256
    """Cells of the surface along an edge of the scene's cube, if a run has no mesh of its own."""
    points: int = 100_000
    """Number of random points of an asset."""
    sheet: Path | None = None
    """Write a picture of the textures of the last run."""


@dataclass(frozen=True)
class GlbPoints:
    """Random points of a GLB file.

    Attributes:
        position: position, world frame.
        values: base colour as displayed, roughness and metallic, 0 … 255, from the textures.
    """

    position: Float[np.ndarray, "N 3"]
    values: Float[np.ndarray, "N 5"]


@dataclass(frozen=True)
class Agreement:
    """Share of values that differ by at most `CLOSE`, and 99th percentile of the differences, of 255."""

    share: float
    largest: float


def random_points(glb: Path, count: int) -> GlbPoints:
    """Distribute points uniformly over the surface of a GLB file, and look them up in its textures."""
    scene = trimesh.load(glb, process=False)
    shape, to_world = scene.geometry["surface"], scene.graph["surface"][0]
    points, face = trimesh.sample.sample_surface(shape, count, seed=SEED)
    points = np.asarray(points)
    weights = trimesh.triangles.points_to_barycentric(shape.triangles[face], points)
    uv = (shape.visual.uv[shape.faces[face]] * weights[..., None]).sum(1)
    pbr = shape.visual.material
    packed = _look_up(np.array(pbr.metallicRoughnessTexture), uv)
    values = np.concatenate([_look_up(np.array(pbr.baseColorTexture), uv), packed[:, 1:]], axis=1)
    position = (points @ to_world[:3, :3].T + to_world[:3, 3]) @ WORLD_TO_GLTF
    return GlbPoints(position, values)


def _look_up(texture: UInt8[np.ndarray, "H W 3"], uv: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 3"]:
    """Bilinear, v upwards."""
    height, width = texture.shape[:2]
    at = [(1 - uv[:, 1]) * height - 0.5, uv[:, 0] * width - 0.5]
    channels = np.moveaxis(texture.astype(float), -1, 0)
    return np.stack([map_coordinates(channel, at, order=1, mode="nearest") for channel in channels], axis=1)


@torch.no_grad()
def field_values(run: Run, position: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 5"]:
    """The material of a run at points of the scene frame, as `GlbPoints.values`."""
    material = materials_in_parts(run, torch.as_tensor(position, dtype=torch.float32, device=run.device))
    parts = (tone_map(material.base_color), material.roughness, material.metallic)
    return 255 * torch.cat(parts, dim=-1).double().cpu().numpy()


def agreement(values: Float[np.ndarray, "N 5"], truth: Float[np.ndarray, "N 5"]) -> dict[str, Agreement]:
    """The figures of base colour, roughness and metallic."""
    off = np.abs(values - truth)
    parts = dict(zip(NAMES, (off[:, :3].max(axis=1), off[:, 3], off[:, 4]), strict=True))
    return {
        name: Agreement(float((part <= CLOSE).mean()), float(np.percentile(part, 99)))
        for name, part in parts.items()
    }


def sheet(folder: Path, out: Path) -> None:
    """Write the textures of an asset side by side."""
    names = [folder / "textures" / f"{name}.png" for name in SHEET]
    tiles = [np.asarray(Image.open(name).convert("RGB").resize((TILE, TILE), Image.BOX)) for name in names]
    write_png(out, np.concatenate(tiles, axis=1))


def measure(path: Path, options: Options, console: Console) -> None:
    """Export one run, and print its figures."""
    run = load_run(path, torch.device("cpu"))
    asset = AssetOptions(options.resolution, options.texture_size)
    check_asset(run, asset)
    with tempfile.TemporaryDirectory() as folder:
        export_asset(run, Path(folder), asset, None, progress_bar, console)
        points = random_points(Path(folder) / "asset.glb", options.points)
        if options.sheet is not None:
            sheet(Path(folder), options.sheet)
    position = run.capture.normalization.to_scene(torch.from_numpy(points.position)).numpy()
    for name, figures in agreement(points.values, field_values(run, position)).items():
        share = f"{100 * figures.share:.2f} % within {CLOSE:g}"
        console.print(f"{path.name}, {name}: {share}, 99 % within {figures.largest:.2f}")


def main(options: Options, console: Console) -> None:
    """Measure, and print."""
    console.print(hardware())
    for path in options.runs:
        measure(path, options, console)


if __name__ == "__main__":
    run_benchmark(lambda: main(tyro.cli(Options), Console(markup=False, highlight=False)))
