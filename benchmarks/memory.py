"""Peak memory of a training as a function of views and megapixels.

    python -m benchmarks.memory --sizes 4x2 16x2
    python -m benchmarks.memory --sizes 100x12 --scale 1 --data captures/teapot

For each size, the views of another capture are resampled to a capture of so many views and megapixels, and a
separate process trains a few steps of the preset `fast` on it. The output has the peak memory of the process
(resident memory, including pages of mapped files), the size of the pixel files, and the size of float32
planes at 19 bytes per pixel.
"""

from __future__ import annotations

import dataclasses
import math
import resource
import shlex
import subprocess
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import tyro
from rich.console import Console

from benchmarks.measure import hardware, revision
from benchmarks.tables import RESULTS, Result, Row, markdown, write_result
from neilfpp_method.data.cameras.camera import scaled_camera
from neilfpp_method.data.capture import load_capture
from neilfpp_method.data.capture_folder import write_capture
from neilfpp_method.data.files.images import read_image, write_exr, write_png
from neilfpp_method.demo.command import demo_scene
from neilfpp_method.settings.presets import preset
from neilfpp_method.train.command import run_training
from neilfpp_method.train.request import TrainingRequest

FLOAT_PLANES = 19
"""Bytes per pixel of colours, masks and gradients in float32 and bool, as they were stored earlier."""


@dataclass
class Options:
    """Measure peak memory."""

    sizes: tuple[str, ...] = ("4x2", "16x2")
    """Sizes as VIEWSxMEGAPIXELS."""
    scale: float | None = 1.0
    """Value of `neilfpp train --scale`; default of the training if not given."""
    data: Path | None = None
    """Capture whose views are resampled; default: that of the demo."""
    steps: int = 20
    """Number of training steps."""
    save: str | None = None
    """Name of the result file in benchmarks/results, for the table of docs/performance.md."""


def enlarged(source: Path, out: Path, views: int, megapixels: float) -> Path:
    """A capture of `views` views of about `megapixels` million pixels, resampled from those of another
    capture in turn.
    """
    capture = load_capture(source, test_every=0)
    listed = []
    for i in range(views):
        view = capture.views[i % len(capture.views)]
        factor = math.sqrt(1e6 * megapixels / (view.camera.width * view.camera.height))
        size = (round(view.camera.width * factor), round(view.camera.height * factor))
        image = read_image(view.image)
        pixels = cv2.resize(image.pixels, size, interpolation=cv2.INTER_LINEAR)
        path = out / "images" / f"{i:04d}{'.exr' if image.hdr else '.png'}"
        if image.hdr:
            write_exr(path, {"RGB": pixels.astype(np.float16)})
        else:
            write_png(path, np.rint(255 * pixels).astype(np.uint8))
        listed.append(
            replace(
                view,
                name=f"{i:04d}",
                index=i,
                camera=scaled_camera(view.camera, *size),
                image=path,
                mask=None,
            )
        )
    made = replace(capture, root=out, inputs=out, views=tuple(listed), point_cloud=None)
    write_capture(out, made, response="linear" if capture.hdr else "srgb", test=frozenset())
    return out


def train_small(data: Path, out: Path, scale: float | None, steps: int) -> None:
    """Train some steps of the preset `fast`, and print the peak memory of this process, bytes, as the last
    line.
    """
    config = preset("fast")
    train = dataclasses.replace(config.train, sdf_steps=steps, material_steps=0, joint_steps=0)
    request = TrainingRequest(
        data=data,
        out=out,
        config=dataclasses.replace(config, train=train),
        test_every=0,
        scale=scale,
        device="cpu",
    )
    run_training(request, Console(quiet=True))
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024)


def main(options: Options) -> None:
    """Measure each size, print the table, and store it if requested."""
    rows = []
    for size in options.sizes:
        count, megapixels = int(size.split("x")[0]), float(size.split("x")[1])
        with tempfile.TemporaryDirectory() as folder:
            data = enlarged(options.data or demo_scene(), Path(folder) / "capture", count, megapixels)
            run = Path(folder) / "run"
            scale = "none" if options.scale is None else str(options.scale)
            arguments = [str(data), str(run), scale, str(options.steps)]
            command = [sys.executable, "-m", "benchmarks.memory", "--child", *arguments]
            done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
            peak = int(done.stdout.splitlines()[-1])
            files = sum(path.stat().st_size for path in (run / "pixels").iterdir())
        planes = FLOAT_PLANES * count * megapixels * 1e6
        figures = {"peak_gb": peak / 1e9, "files_gb": files / 1e9, "planes_gb": planes / 1e9}
        rows.append(Row(f"{count} views of {megapixels:g} megapixels", figures))
        result = Result(
            "memory",
            revision(),
            f"python -m benchmarks.memory {shlex.join(sys.argv[1:])}".strip(),
            hardware(),
            tuple(rows),
        )
        if options.save is not None:
            write_result(RESULTS / f"{options.save}.json", result)
    Console().print(markdown([result]), markup=False, highlight=False, soft_wrap=True)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--child"]:
        data, out, scale, steps = sys.argv[2:]
        train_small(Path(data), Path(out), None if scale == "none" else float(scale), int(steps))
    else:
        main(tyro.cli(Options))
