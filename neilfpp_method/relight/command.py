"""`neilfpp relight`: the views of a run under other light, as files.

RUN/relit/<map>/<view>.exr    linear radiance and alpha, premultiplied
RUN/relit/<map>/<view>.png    the same as a display shows it
RUN/relit/<map>/<view>.json   how it was made; written last: a view that has it is done
RUN/relit/<map>/turntable.mp4
RUN/relit/<map>/metrics.json  where true images are given
"""

from __future__ import annotations

import dataclasses
import hashlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.data.images import read_image, write_exr, write_png
from neilfpp_method.errors import UserError
from neilfpp_method.fields.environment import EnvironmentLight
from neilfpp_method.relight.cameras import Shot, rays_through, turntable, view_shots
from neilfpp_method.relight.comparison import compare, find_truth, read_truth
from neilfpp_method.relight.denoise import check_denoiser, denoised
from neilfpp_method.relight.edits import edited, parse_edits, scene_box
from neilfpp_method.relight.film import Budget, Picture, take_picture
from neilfpp_method.relight.lamplight import lamps_of_run
from neilfpp_method.relight.maps import Layout, check_map, map_names, read_map
from neilfpp_method.relight.movie import write_movie
from neilfpp_method.relight.path_tracer import Scene
from neilfpp_method.relight.recovered import check_material, lobe_of_run, surface_of_run
from neilfpp_method.relight.sky import Sky, sky_of_run
from neilfpp_method.shading.color import tone_map
from neilfpp_method.train.device import pick_device
from neilfpp_method.train.run import Run, check_writable, load_run, read_json, write_json

__all__ = ["Request", "relight"]

OWN = "own"
"""The name of the light that a run has found."""
SAMPLES = 64
"""Per pixel, where neither samples nor seconds are asked for."""
FORMAT = 1


@dataclass(frozen=True)
class Request:
    """What is asked for; the fields are those of `commands.relight.Relight`, which says what they mean."""

    run: Path
    env: tuple[Path, ...]
    env_layout: Layout
    rotate: float
    exposure: float
    lamps: str
    views: str
    frames: int
    edits: tuple[str, ...]
    box: tuple[float, ...] | None
    spp: int | None
    seconds: float | None
    bounces: int
    scale: float | None
    width: int | None
    background: str
    denoise: bool
    truth: tuple[Path, ...]
    out: Path | None
    resolution: int
    force: bool
    checkpoint: str
    device: str


def relight(
    request: Request,
    say: Callable[[str], None] = lambda text: None,
    on_progress: Callable[[float], None] = lambda share: None,
) -> Path:
    """Render what is asked for, and return the folder. Views that are there already, made the same way, are skipped.

    Args:
        request: what.
        say: takes lines for the person who waits.
        on_progress: told the share that is done.

    Raises:
        UserError: something that was asked for cannot be; nothing is written then.
    """
    _check(request)
    run = load_run(request.run, pick_device(request.device), request.checkpoint)
    check_material(run)
    out = request.out or request.run / "relit"
    check_writable(out)
    shots = _shots(request, run)
    lights = _lights(request, run, say)
    jobs = [_Job(name, sky, out / name, _settings(request, run, name)) for name, sky in lights]
    truths = [find_truth(folder, [shot.view for shot in shots]) for folder in request.truth]
    missing = {job.name: [shot for shot in shots if request.force or not job.has(shot)] for job in jobs}
    if any(missing.values()):
        _render(request, run, jobs, missing, on_progress)
    for k, job in enumerate(jobs):
        if request.views == "turntable":
            write_movie(job.folder / "turntable.mp4", [job.folder / f"{shot.name}.png" for shot in shots])
        if truths:
            say(_measure(run, job, shots, truths[k]))
    return out


# ---------------------------------------------------------------------------------------------------- what is asked for


@dataclass(frozen=True)
class _Job:
    """A light, the folder of its pictures, and what they are made with."""

    name: str
    sky: Sky
    folder: Path
    settings: dict[str, Any]

    def has(self, shot: Shot) -> bool:
        """Whether a picture is there.

        Raises:
            UserError: there is one that was made in another way.
        """
        record = self.folder / f"{shot.name}.json"
        if not record.is_file():
            return False
        made = read_json(record)
        other = [key for key, value in self.of(shot).items() if made.get(key) != value]
        if other:
            was, now = made.get(other[0]), self.of(shot)[other[0]]
            raise UserError(
                f"{record}: was made with {other[0]} {was}, not {now}", "choose another --out, or render again with --force"
            )
        return all((self.folder / f"{shot.name}{suffix}").is_file() for suffix in (".exr", ".png"))

    def of(self, shot: Shot) -> dict[str, Any]:
        """What the picture of a shot is made with."""
        return self.settings | {"width": shot.camera.width, "height": shot.camera.height}


def _check(request: Request) -> None:
    """What the words of the request alone can tell."""
    positive = {"--spp": request.spp, "--seconds": request.seconds, "--scale": request.scale, "--width": request.width}
    for option, value in {**positive, "--bounces": request.bounces, "--resolution": request.resolution}.items():
        if value is not None and not (0 < value < float("inf")):
            raise UserError(f"{option} is {value}", "give a positive number")
    if request.bounces > 64:
        raise UserError(f"--bounces is {request.bounces}", "give 64 or fewer: what is left is a share below 1e-3")
    if not all(np.isfinite(value) for value in (request.rotate, request.exposure)):
        raise UserError("--rotate and --exposure are not finite", "give degrees and stops")
    if request.scale is not None and request.width is not None:
        raise UserError("--scale and --width both say how large", "give one of them")
    if request.box is not None and not request.edits:
        raise UserError("--box without --set limits nothing", "say what changes within it, as --set roughness=0.2")
    if request.truth:
        if request.views == "turntable" or request.scale is not None or request.width is not None:
            raise UserError("true images are of views in full size", "leave --views turntable, --scale and --width out")
        if len(request.truth) != max(1, len(request.env)):
            raise UserError(f"{len(request.truth)} folders of true images for {len(request.env)} maps", "give one for each map")
    if request.denoise:
        check_denoiser()
    parse_edits(request.edits)
    for path in request.env:
        check_map(path)
    map_names(request.env)


def _shots(request: Request, run: Run) -> list[Shot]:
    capture = run.capture
    if request.views == "turntable":
        return turntable(capture, request.frames, request.scale, request.width)
    views = {"test": capture.test_views, "train": capture.train_views, "all": capture.views}[request.views]
    return view_shots(capture, views, 1.0 if request.truth else request.scale, request.width)


def _lights(request: Request, run: Run, say: Callable[[str], None]) -> list[tuple[str, Sky]]:
    """The maps by name, on the device of the run; without any the light of the run."""
    device = next(run.model.parameters()).device
    if not request.env:
        if not isinstance(run.model.light, EnvironmentLight):
            raise UserError(f"{run.path}: the light of this run is no environment map", "name a map with --env MAP.exr")
        sky = sky_of_run(run.model.light)
        start = sky.start - np.radians(request.rotate)
        return [(OWN, dataclasses.replace(sky, radiance=sky.radiance * 2.0**request.exposure, start=float(start)))]
    lights = []
    for name, path in zip(map_names(request.env), request.env, strict=True):
        read = read_map(path, request.env_layout, request.rotate, request.exposure)
        if read.negative:
            say(f"{path}: {read.negative} texels are slightly negative, and count as 0")
        lights.append((name, dataclasses.replace(read.sky, radiance=read.sky.radiance.to(device))))
    return lights


def _settings(request: Request, run: Run, name: str) -> dict[str, Any]:
    """Everything that decides what a picture shows, as JSON has it."""
    path = dict(zip(map_names(request.env), request.env, strict=True)).get(name)
    described = {
        "format": FORMAT,
        "map": OWN if path is None else path.name,
        "map_sha256": None if path is None else hashlib.sha256(path.read_bytes()).hexdigest(),
        "layout": request.env_layout if path else "ours",
        "lamps": _with_lamps(request),
        "step": run.step,
        "set": list(request.edits),
        "box": None if request.box is None else list(request.box),
    }
    kept = ("rotate", "exposure", "spp", "seconds", "bounces", "background", "denoise", "resolution")
    return described | {key: getattr(request, key) for key in kept}


def _with_lamps(request: Request) -> bool:
    return request.lamps == "keep" or (request.lamps == "auto" and not request.env)


# --------------------------------------------------------------------------------------------------------------- doing


def _render(
    request: Request,
    run: Run,
    jobs: Sequence[_Job],
    missing: dict[str, list[Shot]],
    on_progress: Callable[[float], None],
) -> None:
    surface, lobe = surface_of_run(run, request.resolution), lobe_of_run(run)
    box = None if request.box is None else scene_box(request.box, run.capture.normalisation)
    materials = edited(run.model.materials, parse_edits(request.edits), box)
    lamps = lamps_of_run(run.model.lamps) if _with_lamps(request) else None
    budget = Budget(request.spp or (SAMPLES if request.seconds is None else None), request.seconds)
    total, done = sum(map(len, missing.values())), 0
    for job in jobs:
        scene = Scene(surface, materials, lobe, job.sky, lamps)
        for shot in missing[job.name]:
            begun = time.monotonic()
            seed = int.from_bytes(hashlib.sha256(shot.name.encode()).digest()[:4], "big")
            before = done

            def report(share: float, before: int = before) -> None:
                on_progress((before + share) / total)

            picture = take_picture(scene, shot.camera, budget, request.bounces, seed, report)
            if request.denoise:
                picture = denoised(picture)
            if request.background == "map":
                picture = _before_sky(picture, job.sky, shot)
            _write(job, shot, picture, time.monotonic() - begun)
            done += 1
            on_progress(done / total)


def _before_sky(picture: Picture, sky: Sky, shot: Shot) -> Picture:
    """The picture with the map behind it."""
    height, width = picture.alpha.shape[:2]
    pixel = torch.arange(height * width, device=picture.alpha.device)
    rays, shown = rays_through(shot.camera, torch.stack((pixel % width, pixel // width), -1) + 0.5)
    behind = (sky.look(rays.directions) * shown[:, None]).view(height, width, 3)
    opaque = torch.ones_like(picture.alpha)
    return dataclasses.replace(picture, radiance=picture.radiance + (1 - picture.alpha) * behind, alpha=opaque)


def _write(job: _Job, shot: Shot, picture: Picture, seconds: float) -> None:
    record = job.folder / f"{shot.name}.json"
    record.unlink(missing_ok=True)  # until all is there again, it is not done
    rgba = torch.cat((picture.radiance, picture.alpha), -1).cpu()
    write_exr(job.folder / f"{shot.name}.exr", {"RGBA": rgba.numpy()})
    write_png(job.folder / f"{shot.name}.png", _displayed(rgba))
    write_json(record, job.of(shot) | {"samples": picture.samples, "took": round(seconds, 2)})


def _displayed(rgba: Float[Tensor, "H W 4"]) -> np.ndarray:
    """8-bit sRGB with alpha, which PNG has not premultiplied."""
    color, alpha = rgba.split([3, 1], dim=-1)
    straight = torch.where(alpha > 0, color / alpha.clamp_min(1e-6), 0.0)
    return (torch.cat((tone_map(straight), alpha), -1) * 255).round().byte().numpy()


def _measure(run: Run, job: _Job, shots: Sequence[Shot], truth: dict[str, Path]) -> str:
    """Compare with true images, write metrics.json, and say the main figures."""
    true = [read_truth(run.capture, shot.view, truth[shot.name]) for shot in shots]
    files = [read_image(job.folder / f"{shot.name}.exr") for shot in shots]
    opacity = [np.ones(f.pixels.shape[:2], np.float32) if f.alpha is None else f.alpha for f in files]
    found = compare([file.pixels for file in files], opacity, true)
    record = {
        **found.figures,
        "views": found.views,
        "scale": list(found.scale),
        "mask_source": found.mask_source,
        "settings": job.settings,
    }
    write_json(job.folder / "metrics.json", record)
    psnr, scaled = found.figures["relight_psnr"], found.figures["relight_psnr_scaled"]
    baseline = found.figures["baseline_psnr_scaled"]
    return f"{job.name}: PSNR {psnr:.2f} dB, scale aligned {scaled:.2f} dB (the training image of each view: {baseline:.2f} dB)"
