"""`neilfpp relight`: render views of a run under other light to files.

Files:

    RUN/relit/<map>/<view>.exr      linear radiance and alpha, premultiplied
    RUN/relit/<map>/<view>.png      the same for display
    RUN/relit/<map>/<view>.json     settings of the image; written last, so it marks a finished image
    RUN/relit/<map>/turntable.mp4   with --views turntable
    RUN/relit/<map>/metrics.json    with --truth
    RUN/cache/                      the extracted surface (`export.surface_cache`)
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

from neilfpp_method.data.json_entry import write_json
from neilfpp_method.errors import UserError
from neilfpp_method.export.mesh import check_resolution
from neilfpp_method.fields.environment import EnvironmentLight
from neilfpp_method.relight.cameras import Shot, pixel_rays, turntable, view_shots
from neilfpp_method.relight.comparison import compare, find_truth, read_truth
from neilfpp_method.relight.denoise import check_denoiser, denoised
from neilfpp_method.relight.edits import parse_edits, scene_box, with_edits
from neilfpp_method.relight.film import Budget, Picture, render_picture
from neilfpp_method.relight.lamp_edits import edited_lamps, parse_lamp_edits
from neilfpp_method.relight.lamplight import Lamplight, lamps_of_run
from neilfpp_method.relight.maps import Layout, check_map, map_names, read_map
from neilfpp_method.relight.movie import write_movie
from neilfpp_method.relight.path_tracer import Scene
from neilfpp_method.relight.picture_folder import PictureFolder
from neilfpp_method.relight.recovered import check_material, surface_of_run
from neilfpp_method.relight.sky import Sky, sky_of_run
from neilfpp_method.relight.stencil import masked_limit, read_stencils
from neilfpp_method.train.checkpoint import checkpoint_path
from neilfpp_method.train.device import pick_device
from neilfpp_method.train.output import check_folder
from neilfpp_method.train.run import Run, load_run

__all__ = ["RelightRequest", "relight"]

OWN = "own"
"""Name of the run's estimated light in paths and records."""
TURNTABLE = "turntable"
"""The word for a circle of cameras in place of views."""
SAMPLES = 64
"""Default number of samples per pixel, if neither --spp nor --seconds is given."""
MAX_EXPOSURE = 64
"""Largest change of the exposure, in stops; float32 holds 254."""
MAX_BOUNCES = 64
"""Largest number of bounces, after which a path carries less than a thousandth of its radiance."""
FORMAT = 1
"""Version of the format of the records."""


@dataclass(frozen=True)
class RelightRequest:
    """Options of the command; `commands.relight.Relight` documents the fields."""

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
    request: RelightRequest,
    say: Callable[[str], None] = lambda text: None,
    on_progress: Callable[[float], None] = lambda share: None,
) -> Path:
    """Render the requested views. Images that exist and have the same settings are skipped.

    Args:
        request: options of the command.
        say: receives messages for the user, line by line.
        on_progress: called with the fraction of the work that is done.

    Returns:
        The folder that contains the images.

    Raises:
        UserError: an option is invalid, or the run lacks what it needs. In these cases no image is written.
    """
    _check(request)
    run = load_run(request.run, pick_device(request.device), request.checkpoint)
    check_material(run)
    out = request.out or request.run / "relit"
    check_folder(out)
    shots = _shots(request, run)
    lights = _lights(request, run, say)
    lamps = _lamps(request, run)
    box = None if request.box is None else scene_box(request.box, run.capture.normalization)
    stencils = read_stencils(request.mask, run.capture)
    folders = {name: PictureFolder(out / name, _settings(request, run, name)) for name in lights}
    truths = [find_truth(folder, [shot.view for shot in shots]) for folder in request.truth]
    missing = {
        name: [s for s in shots if request.force or not folder.has(s)] for name, folder in folders.items()
    }
    if any(missing.values()):
        surface = surface_of_run(run, request.resolution, say)
        if box and not box.may_meet(surface.triangles):
            raise UserError(
                "--box contains no part of the surface", "give two corners in the world frame of the capture"
            )
        limits = ([box.contains] if box else []) + ([masked_limit(stencils, surface)] if stencils else [])
        materials = with_edits(run.model.materials, parse_edits(request.edits), limits)
        scenes = {name: Scene(surface, materials, run.model.lobe, sky, lamps) for name, sky in lights.items()}
        _render(request, scenes, folders, missing, on_progress)
    for k, folder in enumerate(folders.values()):
        if TURNTABLE in request.views:
            write_movie(folder.path / "turntable.mp4", [folder.png(shot) for shot in shots])
        if truths:
            say(_measure(run, folder, shots, truths[k]))
    return out


# ---------------------------------------------------------------------------------------------------- options


def _check(request: RelightRequest) -> None:
    """Check everything that does not need the run."""
    _check_numbers(request)
    _check_combinations(request)
    if request.denoise:
        check_denoiser()
    parse_edits(request.edits)
    parse_lamp_edits(request.lamp_edits)
    for path in request.env:
        check_map(path)
    map_names(request.env)


def _check_numbers(request: RelightRequest) -> None:
    positive = {
        "--spp": request.spp,
        "--seconds": request.seconds,
        "--scale": request.scale,
        "--width": request.width,
        "--bounces": request.bounces,
    }
    for option, value in positive.items():
        if value is not None and not (0 < value < float("inf")):
            raise UserError(f"{option} is {value}", "give a positive number")
    check_resolution(request.resolution)
    if request.bounces > MAX_BOUNCES:
        raise UserError(
            f"--bounces is {request.bounces}",
            f"give at most {MAX_BOUNCES}, after which less than a thousandth of the light is left",
        )
    if not np.isfinite(request.rotate):
        raise UserError(f"--rotate is {request.rotate}", "give degrees")
    if not abs(request.exposure) <= MAX_EXPOSURE:
        raise UserError(
            f"--exposure is {request.exposure}", f"give between −{MAX_EXPOSURE} and {MAX_EXPOSURE} stops"
        )


def _check_combinations(request: RelightRequest) -> None:
    """Reject options that exclude each other, or that have no effect without another one."""
    circle, sized = TURNTABLE in request.views, request.scale is not None or request.width is not None
    if request.scale is not None and request.width is not None:
        raise UserError("--scale and --width both set the size of views", "give only one of them")
    for option, given in (("--box", request.box is not None), ("--mask", bool(request.mask))):
        if given and not request.edits:
            raise UserError(
                f"{option} without --set has no effect",
                "give the change of the material, for example --set roughness=0.2",
            )
    if request.lamp_edits and request.lamps == "drop":
        raise UserError("--lamp changes lamps, but --lamps drop removes all of them", "give only one of both")
    if circle and len(request.views) > 1:
        raise UserError("--views turntable is a circle, and no other views go with it", "give one of them")
    if request.truth and (circle or sized):
        raise UserError(
            "true images can only be compared with views in full size",
            "leave --views turntable, --scale and --width out",
        )
    if request.truth and len(request.truth) != max(1, len(request.env)):
        raise UserError(
            f"{len(request.truth)} folders of true images for {len(request.env)} maps",
            "give one folder for each map",
        )


def _shots(request: RelightRequest, run: Run) -> list[Shot]:
    capture = run.capture
    if TURNTABLE in request.views:
        return turntable(capture, request.frames, request.scale, request.width)
    views = capture.chosen_views(request.views)
    return view_shots(capture, views, 1.0 if request.truth else request.scale, request.width)


def _lights(request: RelightRequest, run: Run, say: Callable[[str], None]) -> dict[str, Sky]:
    """The environment maps by name, on the device of the run; the run's own light if no map is given."""
    device = run.device
    if not request.env:
        if not isinstance(run.model.light, EnvironmentLight):
            raise UserError(
                f"{run.path}: the light of this run is no environment map", "give a map with --env MAP.exr"
            )
        sky = sky_of_run(run.model.light)
        start = float(sky.start - np.radians(request.rotate))
        radiance = sky.radiance * 2.0**request.exposure
        return {OWN: dataclasses.replace(sky, radiance=radiance, start=start)}
    lights = {}
    for name, path in zip(map_names(request.env), request.env, strict=True):
        light_map = read_map(path, request.env_layout, request.rotate, request.exposure)
        if light_map.negative:
            texels = "texel is" if light_map.negative == 1 else "texels are"
            say(f"{path}: {light_map.negative} {texels} slightly negative; set to 0")
        lights[name] = dataclasses.replace(light_map.sky, radiance=light_map.sky.radiance.to(device))
    return lights


def _settings(request: RelightRequest, run: Run, name: str) -> dict[str, Any]:
    """All settings that affect an image, as values for JSON."""
    path = dict(zip(map_names(request.env), request.env, strict=True)).get(name)
    weights = checkpoint_path(run.path, request.checkpoint)
    settings = {
        "format": FORMAT,
        "map": OWN if path is None else path.name,
        "map_sha256": None if path is None else hashlib.sha256(path.read_bytes()).hexdigest(),
        "layout": request.env_layout if path else "ours",
        "lamps": _with_lamps(request),
        "lamp": list(request.lamp_edits),
        "step": run.step,
        "weights_sha256": hashlib.sha256(weights.read_bytes()).hexdigest(),
        "set": list(request.edits),
        "box": None if request.box is None else list(request.box),
        "mask": [[path.name, hashlib.sha256(path.read_bytes()).hexdigest()] for path in request.mask],
    }
    budget = _budget(request)
    settings |= {"spp": budget.samples, "seconds": budget.seconds}
    copied = ("rotate", "exposure", "bounces", "background", "denoise", "resolution")
    return settings | {key: getattr(request, key) for key in copied}


def _budget(request: RelightRequest) -> Budget:
    """The limits per image, with the default number of samples if the options set no limit."""
    return Budget(request.spp or (SAMPLES if request.seconds is None else None), request.seconds)


def _with_lamps(request: RelightRequest) -> bool:
    """Whether the run's lamps are lit: if requested, and by default under the run's own light."""
    requested = request.lamps == "keep" or bool(request.lamp_edits)
    return requested or (request.lamps == "auto" and not request.env)


def _lamps(request: RelightRequest, run: Run) -> Lamplight | None:
    if not _with_lamps(request):
        return None
    edits = parse_lamp_edits(request.lamp_edits)
    return edited_lamps(lamps_of_run(run.model.lamps), edits, run.capture.normalization)


# -------------------------------------------------------------------------------------------------- rendering


def _render(
    request: RelightRequest,
    scenes: Mapping[str, Scene],
    folders: Mapping[str, PictureFolder],
    missing: Mapping[str, Sequence[Shot]],
    on_progress: Callable[[float], None],
) -> None:
    budget = _budget(request)
    work = [(scenes[name], folders[name], shot) for name, shots in missing.items() for shot in shots]
    for done, (scene, folder, shot) in enumerate(work):

        def report(share: float, done: int = done) -> None:
            on_progress((done + share) / len(work))

        begun = time.monotonic()
        # The seed depends on the name only, so that an image does not depend on which others are rendered.
        seed = int.from_bytes(hashlib.sha256(shot.name.encode()).digest()[:4], "big")
        picture = render_picture(scene, shot.camera, budget, request.bounces, seed, report)
        if request.denoise:
            picture = denoised(picture)
        if request.background == "map":
            picture = _over_sky(picture, scene.sky, shot)
        folder.write(shot, picture, time.monotonic() - begun)
        report(1.0)


def _over_sky(picture: Picture, sky: Sky, shot: Shot) -> Picture:
    """Composite the image over the environment map."""
    height, width = picture.alpha.shape[:2]
    seen = pixel_rays(shot.camera, torch.arange(height * width, device=picture.alpha.device))
    background = (sky.lookup(seen.rays.directions) * seen.valid[:, None]).view(height, width, 3)
    radiance = picture.radiance + (1 - picture.alpha) * background
    return dataclasses.replace(picture, radiance=radiance, alpha=torch.ones_like(picture.alpha))


def _measure(run: Run, folder: PictureFolder, shots: Sequence[Shot], truth: Mapping[str, Path]) -> str:
    """Compare with true images, write metrics.json, and return one line with the main figures."""
    true = [read_truth(run.capture, shot.view, truth[shot.name]) for shot in shots]
    relit = [folder.read(shot) for shot in shots]
    result = compare([image.radiance for image in relit], [image.alpha for image in relit], true)
    details = {"views": result.views, "scale": list(result.scale), "mask_source": result.mask_source}
    write_json(folder.path / "metrics.json", {**result.figures, **details, "settings": folder.settings})
    psnr, scaled, baseline = (
        f"{result.figures[name]:.2f} dB"
        for name in ("relight_psnr", "relight_psnr_scaled", "baseline_psnr_scaled")
    )
    return f"{folder.path.name}: PSNR {psnr}, after scaling {scaled} (photograph of each view: {baseline})"
