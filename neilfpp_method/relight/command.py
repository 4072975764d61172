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
from pathlib import Path
from typing import Any

import numpy as np
import torch

from neilfpp_method.data.files.json_entry import write_json
from neilfpp_method.errors import UserError
from neilfpp_method.evaluate.size import at_size
from neilfpp_method.fields.environment import EnvironmentLight
from neilfpp_method.relight.cameras import Shot, pixel_rays, turntable, view_shots
from neilfpp_method.relight.comparison import compare, find_truth, read_truth
from neilfpp_method.relight.denoise import denoised
from neilfpp_method.relight.edits import parse_edits, scene_box, with_edits
from neilfpp_method.relight.film import Picture, render_picture
from neilfpp_method.relight.lamp_edits import edited_lamps, parse_lamp_edits
from neilfpp_method.relight.lamplight import Lamplight, lamps_of_run
from neilfpp_method.relight.maps import map_names, read_map
from neilfpp_method.relight.movie import write_movie
from neilfpp_method.relight.path_tracer import Scene
from neilfpp_method.relight.picture_folder import PictureFolder
from neilfpp_method.relight.recovered import surface_of_run
from neilfpp_method.relight.request import RelightRequest, check_request
from neilfpp_method.relight.sky import Sky, sky_of_run
from neilfpp_method.relight.stencil import masked_limit, read_stencils
from neilfpp_method.train.checkpoint import checkpoint_path
from neilfpp_method.train.device import pick_device
from neilfpp_method.train.output import check_folder
from neilfpp_method.train.run import Run, check_material, load_run

__all__ = ["relight"]

OWN = "own"
"""Name of the run's estimated light in paths and records."""
FRAMES = 96
"""Default number of frames of a turntable: four seconds of film."""
FORMAT = 1
"""Version of the format of the records."""


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
    check_request(request)
    run = load_run(request.run, pick_device(request.device), request.checkpoint)
    check_material(run)
    # True images have the size of the files; the run may be trained at a smaller one.
    run = at_size(run, scale=1.0) if request.truth else run
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
        if request.is_turntable:
            write_movie(folder.path / "turntable.mp4", [folder.png(shot) for shot in shots])
        if truths:
            say(_measure(run, folder, shots, truths[k]))
    return out


# -------------------------------------------------------------------------------------- what the options mean


def _shots(request: RelightRequest, run: Run) -> list[Shot]:
    capture = run.capture
    if request.is_turntable:
        frames = FRAMES if request.frames is None else request.frames
        return turntable(capture, frames, request.scale, request.width)
    views = capture.chosen_views(request.views)
    return view_shots(capture, views, 1.0 if request.truth else request.scale, request.width)


def _lights(request: RelightRequest, run: Run, say: Callable[[str], None]) -> dict[str, Sky]:
    """The environment maps by name, on the device of the run; the run's own light if no map is given."""
    device = run.device
    if not request.env:
        if not isinstance(run.model.light, EnvironmentLight):
            raise UserError(
                f"{run.path}: the light of this run is not an environment map",
                "give a map with --env MAP.exr",
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
        "map_sha256": None if path is None else _sha256(path),
        "layout": request.env_layout if path else "ours",
        "lamps": request.lights_lamps,
        "lamp": list(request.lamp_edits),
        "step": run.step,
        "weights_sha256": _sha256(weights),
        "set": list(request.edits),
        "box": None if request.box is None else list(request.box),
        "mask": [[path.name, _sha256(path)] for path in request.mask],
    }
    settings |= {"spp": request.budget.samples, "seconds": request.budget.seconds}
    copied = ("rotate", "exposure", "bounces", "background", "denoise", "resolution")
    return settings | {key: getattr(request, key) for key in copied}


def _sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _lamps(request: RelightRequest, run: Run) -> Lamplight | None:
    if not request.lights_lamps:
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
    work = [(scenes[name], folders[name], shot) for name, shots in missing.items() for shot in shots]
    for done, (scene, folder, shot) in enumerate(work):

        def report(share: float, done: int = done) -> None:
            on_progress((done + share) / len(work))

        begun = time.monotonic()
        # The seed depends on the name only, so that an image does not depend on which others are rendered.
        seed = int.from_bytes(hashlib.sha256(shot.name.encode()).digest()[:4], "big")
        picture = render_picture(scene, shot.camera, request.budget, request.bounces, seed, report)
        if request.denoise:
            picture = denoised(picture)
        if request.background == "map":
            picture = _over_sky(picture, scene.sky, shot)
        folder.write(shot, picture, time.monotonic() - begun)
        report(1.0)


def _over_sky(picture: Picture, sky: Sky, shot: Shot) -> Picture:
    """Composite the image over the environment map."""
    height, width = picture.alpha.shape[:2]
    pixels = pixel_rays(shot.camera, torch.arange(height * width, device=picture.alpha.device))
    background = (sky.lookup(pixels.rays.directions) * pixels.valid[:, None]).view(height, width, 3)
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
