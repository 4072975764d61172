"""Compare trained runs under a light that they were not trained with with true images.

    python -m benchmarks.relit --capture DATA/tabletop_env --under DATA/tabletop_relight
    python -m benchmarks.relit --capture DATA/tabletop_env --under DATA/tabletop_relight --runs RUN --exchange
    python -m benchmarks.relit --capture DATA/spot_city --under DATA/spot_city/relit_forest --lobe ggx

The rows are means over the test views: for the photograph of the view as it is; for the true surface with
the true material, which has only the error and noise of the path tracer, if `--lobe` is that of the images;
and for each run. `--exchange` adds
two rows per run that show the cause of its error: its roughness and metallic with the true base colour, and
its base colour with the true roughness and metallic. The figures are those of `neilfpp relight --truth`.
`--save NAME` writes them for docs/relighting.md.
"""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import torch
import tyro
from jaxtyping import Float
from rich.console import Console
from scipy.spatial import cKDTree
from torch import Tensor

from benchmarks.command import run_benchmark
from benchmarks.measure import hardware, revision
from benchmarks.tables import COLUMNS, RESULTS, Result, Row, markdown, write_result
from neilfpp_method.data.cameras.projection import camera_rays
from neilfpp_method.data.capture import Capture, load_capture
from neilfpp_method.data.mesh import Mesh
from neilfpp_method.data.truth import Truth
from neilfpp_method.errors import UserError
from neilfpp_method.hosts.mesh import MeshHost
from neilfpp_method.relight.comparison import RelitComparison, compare, find_truth, read_truth
from neilfpp_method.relight.denoise import check_denoiser, denoised
from neilfpp_method.relight.edits import Materials
from neilfpp_method.relight.film import Budget, render_picture
from neilfpp_method.relight.maps import read_map
from neilfpp_method.relight.path_tracer import Scene
from neilfpp_method.relight.recovered import surface_of_run
from neilfpp_method.relight.surface import Surface
from neilfpp_method.settings.facts import SceneFacts
from neilfpp_method.settings.types import NeilfConfig
from neilfpp_method.shading.brdf import LOBES
from neilfpp_method.structures import Material
from neilfpp_method.train.device import pick_device
from neilfpp_method.train.run import Run, check_material, load_run

__all__ = ["true_materials", "true_surface"]

BOUNCES = 6
TABLE = "relit"


@dataclass
class Options:
    """Measure runs, the truth and a baseline under a light other than that of training."""

    capture: Path
    """A capture with a mesh and with true materials of its test views."""
    under: Path
    """The test views under another light: envmap.exr and images/."""
    runs: tuple[Path, ...] = ()
    """Runs on this capture."""
    lobe: Literal["spherical_gaussian", "ggx", "ggx_burley"] = "spherical_gaussian"
    """Specular lobe with which the true images were rendered, for the true material."""
    exchange: bool = False
    """Also measure each run with the true base colour, and with the true roughness and metallic."""
    spp: int = 64
    """Samples per pixel."""
    denoise: bool = False
    """Denoise the pictures (needs the extra `denoise`)."""
    resolution: int = 512
    """Cells of the traced mesh along an edge of the scene's cube, if a run has no mesh of its own."""
    save: str | None = None
    """Name of the result file in benchmarks/results; default: none is written."""


# ------------------------------------------------------------------------------------------------------ truth


def true_materials(capture: Capture) -> Materials:
    """The material of any point: that of the nearest point in a test view.

    Raises:
        UserError: the capture has no true depth and materials.
    """
    truth, places, values = Truth(capture), [], []
    for view in capture.test_views:
        depth, material = truth.depth(view), truth.material(view)
        if depth is None or material is None:
            raise UserError(f"{capture.root}: no true materials", "take a capture with ground truth")
        camera = capture.scene_camera(view)
        rays, shown = camera_rays(camera), depth > 0
        along = rays.directions @ torch.as_tensor(camera.w2c[2, :3], dtype=torch.float32)
        places.append((rays.origins + rays.directions * (depth / along)[:, None])[shown])
        values.append(torch.cat([material.base_color, material.roughness, material.metallic], -1)[shown])
    tree, rows = cKDTree(torch.cat(places).numpy()), torch.cat(values)

    def materials(x: Float[Tensor, "N 3"]) -> Material:
        return Material(*rows[torch.from_numpy(tree.query(x.numpy())[1])].split([3, 1, 1], dim=-1))

    return materials


def true_surface(capture: Capture) -> Surface:
    """The mesh of a capture with the normals of the mesh host.

    Raises:
        UserError: the capture has no mesh.
    """
    mesh: Mesh | None = Truth(capture).mesh()
    if mesh is None:
        raise UserError(f"{capture.root}: no inputs/model/mesh.ply", "take a capture with its mesh")
    host = MeshHost(mesh, NeilfConfig(), SceneFacts("linear", 0.2, 1.0, "constant"))
    return Surface(host.triangles, host.corner_normals)


# ------------------------------------------------------------------------------------------------ measurement


def scenes(options: Options, capture: Capture) -> Iterator[tuple[str, Scene]]:
    """The rendered scenes by the names of the rows; a run is read when it is needed."""
    sky, materials = read_map(options.under / "envmap.exr", "ours").sky, true_materials(capture)
    yield "true material", Scene(true_surface(capture), materials, LOBES[options.lobe], sky)
    for path in options.runs:
        run = load_run(path, pick_device("cpu"))
        check_material(run)
        name = f"`{run.config.preset}`, {run.step} steps"
        scene = Scene(surface_of_run(run, options.resolution), run.model.materials, run.model.lobe, sky)
        yield name, scene
        if options.exchange:
            yield f"{name}, true base colour", replace(scene, materials=mixed(run, materials, "base_color"))
            others = mixed(run, materials, "roughness", "metallic")
            yield f"{name}, true roughness and metallic", replace(scene, materials=others)


def mixed(run: Run, truth: Materials, *names: str) -> Materials:
    """The material of a run with some parameters replaced by the truth."""

    def materials(x: Float[Tensor, "N 3"]) -> Material:
        known = truth(x)
        return replace(run.model.materials(x), **{name: getattr(known, name) for name in names})

    return materials


def measure(options: Options, say: Callable[[str], None]) -> list[Row]:
    """Measure all rows, the baseline first.

    Raises:
        UserError: a file is missing or invalid.
    """
    if options.denoise:
        check_denoiser()
    capture = load_capture(options.capture)
    views, files = capture.test_views, find_truth(options.under / "images", capture.test_views)
    truths = [read_truth(capture, view, files[view.name]) for view in views]
    cameras = [capture.scene_camera(view) for view in views]
    rows: list[Row] = []
    for name, scene in scenes(options, capture):
        pictures = []
        for camera in cameras:
            picture = render_picture(scene, camera, Budget(options.spp), BOUNCES)
            pictures.append(denoised(picture) if options.denoise else picture)
        found = compare(
            [picture.radiance.numpy() for picture in pictures],
            [picture.alpha[..., 0].numpy() for picture in pictures],
            truths,
        )
        if not rows:
            rows.append(Row("training image", figures(found, "baseline"), capture_name(options)))
            say(described(rows[-1]))
        rows.append(Row(name, figures(found, "relight"), capture_name(options)))
        say(described(rows[-1]) + "; scale " + ", ".join(f"{factor:.3f}" for factor in found.scale))
    return rows


def figures(found: RelitComparison, title: str) -> dict[str, float]:
    """The figures of the table, under the names of the relit images."""
    renamed = {
        key.replace(title, "relight", 1): value for key, value in found.figures.items() if title in key
    }
    return {key: value for key, value in renamed.items() if key in COLUMNS}


def capture_name(options: Options) -> str:
    """The capture and the light of a row."""
    return f"{options.capture.name} under {options.under.name}"


def described(row: Row) -> str:
    """One line for the console."""
    return f"{row.name}: " + ", ".join(
        f"{COLUMNS[key].title} {value:.2f}" for key, value in row.figures.items()
    )


def main(options: Options, console: Console) -> None:
    """Measure, print, and write the result file."""

    def say(text: str) -> None:
        console.print(text, highlight=False, soft_wrap=True)

    say(hardware())
    rows = measure(options, say)
    command = f"python -m benchmarks.relit {shlex.join(sys.argv[1:])}"
    result = Result(TABLE, revision(), command, hardware(), tuple(rows))
    if options.save is not None:
        write_result(RESULTS / f"{options.save}.json", result)
    say(markdown([result]))


if __name__ == "__main__":
    run_benchmark(lambda: main(tyro.cli(Options), Console(markup=False)))
