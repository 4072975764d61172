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
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from neilfpp_method.errors import UserError
from neilfpp_method.fields.environment import EnvironmentLight
from neilfpp_method.relight.cameras import Shot, chosen_views, rays_through, turntable, view_shots
from neilfpp_method.relight.comparison import compare, find_truth, read_truth
from neilfpp_method.relight.denoise import check_denoiser, denoised
from neilfpp_method.relight.edits import edited, parse_edits, scene_box
from neilfpp_method.relight.film import Budget, Picture, take_picture
from neilfpp_method.relight.lamp_edits import edited_lamps, parse_lamp_edits
from neilfpp_method.relight.lamplight import Lamplight, lamps_of_run
from neilfpp_method.relight.maps import Layout, check_map, map_names, read_map
from neilfpp_method.relight.movie import write_movie
from neilfpp_method.relight.path_tracer import Scene
from neilfpp_method.relight.picture_folder import PictureFolder
from neilfpp_method.relight.recovered import check_material, surface_of_run
from neilfpp_method.relight.sky import Sky, sky_of_run
from neilfpp_method.relight.stencil import painted, read_stencils
from neilfpp_method.train.device import pick_device
from neilfpp_method.train.run import Run, check_folder, load_run, write_json

__all__ = ["Request", "relight"]

OWN = "own"
"""The name of the light that a run has found."""
TURNTABLE = "turntable"
"""The word for a circle of cameras in place of views."""
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
    lamp_edits: tuple[str, ...]
    views: tuple[str, ...]
    frames: int
    edits: tuple[str, ...]
    box: tuple[float, ...] | None
    mask: tuple[Path, ...]
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
    """Render what is asked for, and return the folder. Views that are there, made the same way, are skipped.

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
    check_folder(out)
    shots = _shots(request, run)
    lights = _lights(request, run, say)
    lamps = _lamps(request, run)
    box = None if request.box is None else scene_box(request.box, run.capture.normalisation)
    stencils = read_stencils(request.mask, run.capture)
    folders = {name: PictureFolder(out / name, _settings(request, run, name)) for name in lights}
    truths = [find_truth(folder, [shot.view for shot in shots]) for folder in request.truth]
    missing = {
        name: [s for s in shots if request.force or not folder.has(s)] for name, folder in folders.items()
    }
    if any(missing.values()):
        surface = surface_of_run(run, request.resolution)
        limits = ([box.holds] if box else []) + ([painted(stencils, surface)] if stencils else [])
        materials = edited(run.model.materials, parse_edits(request.edits), limits)
        scenes = {name: Scene(surface, materials, run.model.lobe, sky, lamps) for name, sky in lights.items()}
        _render(request, scenes, folders, missing, on_progress)
    for k, folder in enumerate(folders.values()):
        if TURNTABLE in request.views:
            write_movie(folder.path / "turntable.mp4", [folder.png(shot) for shot in shots])
        if truths:
            say(_measure(run, folder, shots, truths[k]))
    return out


# ------------------------------------------------------------------------------------------ what is asked for


def _check(request: Request) -> None:
    """What the words of the request alone can tell."""
    positive = {
        "--spp": request.spp,
        "--seconds": request.seconds,
        "--scale": request.scale,
        "--width": request.width,
    }
    for option, value in {
        **positive,
        "--bounces": request.bounces,
        "--resolution": request.resolution,
    }.items():
        if value is not None and not (0 < value < float("inf")):
            raise UserError(f"{option} is {value}", "give a positive number")
    if request.bounces > 64:
        raise UserError(
            f"--bounces is {request.bounces}", "give 64 or fewer: what is left is a share below 1e-3"
        )
    if not all(np.isfinite(value) for value in (request.rotate, request.exposure)):
        raise UserError("--rotate and --exposure are not finite", "give degrees and stops")
    if request.scale is not None and request.width is not None:
        raise UserError("--scale and --width both say how large", "give one of them")
    for option, given in (("--box", request.box is not None), ("--mask", bool(request.mask))):
        if given and not request.edits:
            raise UserError(
                f"{option} without --set limits nothing", "say what changes within it, as --set roughness=0.2"
            )
    if request.lamp_edits and request.lamps == "drop":
        raise UserError("--lamp moves what --lamps drop leaves out", "give one of them")
    if TURNTABLE in request.views and len(request.views) > 1:
        raise UserError("--views turntable is a circle, and no other views go with it", "give one of them")
    if request.truth:
        if TURNTABLE in request.views or request.scale is not None or request.width is not None:
            raise UserError(
                "true images are of views in full size", "leave --views turntable, --scale and --width out"
            )
        if len(request.truth) != max(1, len(request.env)):
            raise UserError(
                f"{len(request.truth)} folders of true images for {len(request.env)} maps",
                "give one for each map",
            )
    if request.denoise:
        check_denoiser()
    parse_edits(request.edits)
    parse_lamp_edits(request.lamp_edits)
    for path in request.env:
        check_map(path)
    map_names(request.env)


def _shots(request: Request, run: Run) -> list[Shot]:
    capture = run.capture
    if TURNTABLE in request.views:
        return turntable(capture, request.frames, request.scale, request.width)
    views = chosen_views(capture, request.views)
    return view_shots(capture, views, 1.0 if request.truth else request.scale, request.width)


def _lights(request: Request, run: Run, say: Callable[[str], None]) -> dict[str, Sky]:
    """The maps by name, on the device of the run; without any the light of the run."""
    device = next(run.model.parameters()).device
    if not request.env:
        if not isinstance(run.model.light, EnvironmentLight):
            raise UserError(
                f"{run.path}: the light of this run is no environment map", "name a map with --env MAP.exr"
            )
        sky = sky_of_run(run.model.light)
        start = sky.start - np.radians(request.rotate)
        return {
            OWN: dataclasses.replace(sky, radiance=sky.radiance * 2.0**request.exposure, start=float(start))
        }
    lights = {}
    for name, path in zip(map_names(request.env), request.env, strict=True):
        read = read_map(path, request.env_layout, request.rotate, request.exposure)
        if read.negative:
            texels = "texel is" if read.negative == 1 else "texels are"
            say(f"{path}: {read.negative} {texels} slightly negative; replaced by 0")
        lights[name] = dataclasses.replace(read.sky, radiance=read.sky.radiance.to(device))
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
        "lamp": list(request.lamp_edits),
        "step": run.step,
        "set": list(request.edits),
        "box": None if request.box is None else list(request.box),
        "mask": [[path.name, hashlib.sha256(path.read_bytes()).hexdigest()] for path in request.mask],
    }
    kept = ("rotate", "exposure", "spp", "seconds", "bounces", "background", "denoise", "resolution")
    return described | {key: getattr(request, key) for key in kept}


def _with_lamps(request: Request) -> bool:
    """Whether lamps shine: those under the run's own light, and those that somebody has asked for."""
    asked = request.lamps == "keep" or bool(request.lamp_edits)
    return asked or (request.lamps == "auto" and not request.env)


def _lamps(request: Request, run: Run) -> Lamplight | None:
    if not _with_lamps(request):
        return None
    edits = parse_lamp_edits(request.lamp_edits)
    return edited_lamps(lamps_of_run(run.model.lamps), edits, run.capture.normalisation)


# ------------------------------------------------------------------------------------------------------ doing


def _render(
    request: Request,
    scenes: Mapping[str, Scene],
    folders: Mapping[str, PictureFolder],
    missing: Mapping[str, Sequence[Shot]],
    on_progress: Callable[[float], None],
) -> None:
    budget = Budget(request.spp or (SAMPLES if request.seconds is None else None), request.seconds)
    work = [(scenes[name], folders[name], shot) for name, shots in missing.items() for shot in shots]
    for done, (scene, folder, shot) in enumerate(work):

        def report(share: float, done: int = done) -> None:
            on_progress((done + share) / len(work))

        begun = time.monotonic()
        # By name: what a view shows does not depend on which others are rendered.
        seed = int.from_bytes(hashlib.sha256(shot.name.encode()).digest()[:4], "big")
        picture = take_picture(scene, shot.camera, budget, request.bounces, seed, report)
        if request.denoise:
            picture = denoised(picture)
        if request.background == "map":
            picture = _before_sky(picture, scene.sky, shot)
        folder.write(shot, picture, time.monotonic() - begun)
        report(1.0)


def _before_sky(picture: Picture, sky: Sky, shot: Shot) -> Picture:
    """The picture with the map behind it."""
    height, width = picture.alpha.shape[:2]
    pixel = torch.arange(height * width, device=picture.alpha.device)
    rays, shown = rays_through(shot.camera, torch.stack((pixel % width, pixel // width), -1) + 0.5)
    behind = (sky.look(rays.directions) * shown[:, None]).view(height, width, 3)
    opaque = torch.ones_like(picture.alpha)
    return dataclasses.replace(
        picture, radiance=picture.radiance + (1 - picture.alpha) * behind, alpha=opaque
    )


def _measure(run: Run, folder: PictureFolder, shots: Sequence[Shot], truth: Mapping[str, Path]) -> str:
    """Compare with true images, write metrics.json, and say the main figures."""
    true = [read_truth(run.capture, shot.view, truth[shot.name]) for shot in shots]
    relit = [folder.read(shot) for shot in shots]
    found = compare([image.radiance for image in relit], [image.alpha for image in relit], true)
    described = {"views": found.views, "scale": list(found.scale), "mask_source": found.mask_source}
    write_json(folder.path / "metrics.json", {**found.figures, **described, "settings": folder.settings})
    figures = (found.figures[f"{name}_scaled"] for name in ("relight_psnr", "baseline_psnr"))
    scaled, baseline = (f"{figure:.2f} dB" for figure in figures)
    plain = f"PSNR {found.figures['relight_psnr']:.2f} dB"
    return (
        f"{folder.path.name}: {plain}, scale aligned {scaled} (the training image of each view: {baseline})"
    )
