"""Compare the exported asset of a run, rendered by Blender, with the path tracer of this package.

    python -m benchmarks.blender RUN --python BPY/bin/python --percent 50 --samples 128

Blender is the package bpy in a separate environment (`python -m venv BPY`, `BPY/bin/pip install bpy`),
because it needs its own versions of Python and NumPy. The script of the asset, `open_in_blender.py`, opens it
from the GLB and from the USD file, and Cycles renders it under the light of the run. The path tracer of this
package renders the same camera with the run's own surface and material. The PSNR is that of displayed values,
over pixels at least one pixel inside the outline of the surface.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
import tyro
from jaxtyping import Bool, Float
from rich.console import Console
from scipy.ndimage import binary_erosion

from benchmarks.command import run_benchmark
from benchmarks.measure import hardware
from neilfpp_method.commands.command import progress_bar
from neilfpp_method.data.files.images import read_image
from neilfpp_method.errors import UserError
from neilfpp_method.evaluate import metrics
from neilfpp_method.export.asset.command import AssetOptions, check_asset, export_asset
from neilfpp_method.fields.environment import EnvironmentLight
from neilfpp_method.relight.cameras import resized
from neilfpp_method.relight.film import Budget, Picture, render_picture
from neilfpp_method.relight.lamplight import lamps_of_run
from neilfpp_method.relight.path_tracer import Scene
from neilfpp_method.relight.recovered import surface_of_run
from neilfpp_method.relight.sky import sky_of_run
from neilfpp_method.shading.color import tone_map
from neilfpp_method.train.run import Run, load_run

__all__ = ["Shot", "blender_picture", "shown_psnr"]

BOUNCES = 6
TEXTURE_SIZE, FACES, ERROR = 2048, 30_000, 0.001
MAX_SECONDS = 3600


@dataclass
class Options:
    """Compare Cycles' image of an exported asset with the image of this package."""

    run: tyro.conf.Positional[Path]
    """A run with a surface and an environment map."""
    python: Path = Path(sys.executable)
    """A Python that has bpy."""
    camera: str | None = None
    """Name of a view; default: the first test view."""
    percent: int = 100
    """Size of the images relative to the view, in per cent."""
    samples: int = 128
    """Samples per pixel, for Blender and for this package."""
    resolution: int = 256
    """Cells of the surface along an edge of the scene's cube, if the run has no mesh of its own."""
    out: Path | None = None
    """Folder for the asset and Blender's images; default: they are not kept."""


@dataclass(frozen=True)
class Shot:
    """An image that Blender renders: the name of a camera, the file that it opens, size and samples."""

    camera: str
    source: Literal["glb", "usd"] = "glb"
    percent: int = 100
    samples: int = 128


def blender_picture(python: Path, asset: Path, shot: Shot, out: Path) -> Float[np.ndarray, "H W 3"]:
    """Linear radiance rendered by Cycles with the script of the asset; the map is visible behind the surface.

    Raises:
        UserError: that Python has no bpy, or the script fails.
    """
    words = [python, asset / "open_in_blender.py", "--camera", shot.camera, "--render", out]
    words += ["--source", shot.source, "--percent", shot.percent, "--samples", shot.samples]
    done = subprocess.run(
        [str(word) for word in words], capture_output=True, text=True, timeout=MAX_SECONDS, check=False
    )
    if done.returncode or not out.is_file():
        last = (done.stderr.strip() or done.stdout.strip() or "no output").splitlines()[-1]
        remedy = "name a Python that has bpy with --python (pip install bpy, in an environment of its own)"
        raise UserError(f"{python}: Blender did not render ({last})", remedy)
    return read_image(out).pixels


def shown_psnr(
    one: Float[np.ndarray, "H W 3"], other: Float[np.ndarray, "H W 3"], mask: Bool[np.ndarray, "H W"]
) -> float:
    """PSNR of linear radiance as displayed values, over a mask, dB."""
    shown = [tone_map(torch.from_numpy(np.ascontiguousarray(side))).numpy() for side in (one, other)]
    return metrics.psnr(*shown, mask)


def own_picture(run: Run, name: str, options: Options) -> Picture:
    """The view rendered by the path tracer of this package, under the run's own light and lamps."""
    if not isinstance(run.model.light, EnvironmentLight):
        raise UserError(f"{run.path}: the light of this run is no environment map", "choose another run")
    view = next((view for view in run.capture.views if view.name == name), None)
    if view is None:
        raise UserError(f"{run.path}: the capture has no view '{name}'", "name one with --camera")
    surface, sky = surface_of_run(run, options.resolution), sky_of_run(run.model.light)
    scene = Scene(surface, run.model.materials, run.model.lobe, sky, lamps_of_run(run.model.lamps))
    camera = resized(run.capture.scene_camera(view), options.percent / 100)
    return render_picture(scene, camera, Budget(options.samples), BOUNCES)


def compare(options: Options, folder: Path, console: Console) -> None:
    """Export the asset, render it with both programs, and print the comparison."""
    run = load_run(options.run, torch.device("cpu"))
    asset_options = AssetOptions(options.resolution, TEXTURE_SIZE, FACES, ERROR)
    check_asset(run, asset_options)
    name = options.camera or run.capture.test_views[0].name
    ours = own_picture(run, name, options)
    radiance = ours.radiance.numpy()
    within = binary_erosion(ours.alpha[..., 0].numpy() == 1)
    asset = folder / "asset"
    export_asset(run, asset, asset_options, None, progress_bar, console)
    for source in ("glb", "usd"):
        if not (asset / f"asset.{source}{'a' if source == 'usd' else ''}").is_file():
            continue
        out = folder / f"{name}-{source}.exr"
        theirs = blender_picture(
            options.python, asset, Shot(name, source, options.percent, options.samples), out
        )
        share = theirs[within].mean(0) / radiance[within].mean(0)
        channels = ", ".join(f"{factor:.3f}" for factor in share)
        console.print(
            f"{source}, view {name}: PSNR {shown_psnr(theirs, radiance, within):.1f} dB over "
            f"{within.sum()} pixels, mean radiance {channels} of ours"
        )


def main(options: Options, console: Console) -> None:
    """Measure, and print."""
    console.print(hardware())
    if options.out is not None:
        compare(options, options.out, console)
        return
    with tempfile.TemporaryDirectory() as folder:
        compare(options, Path(folder), console)


if __name__ == "__main__":
    run_benchmark(lambda: main(tyro.cli(Options), Console(markup=False, highlight=False)))
