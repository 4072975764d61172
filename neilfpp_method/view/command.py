"""`neilfpp view`: load a run, open the page, and stay until a person stops it."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib import metadata
from pathlib import Path

from neilfpp_method.errors import UserError
from neilfpp_method.relight.maps import Layout, check_map, map_names, read_map
from neilfpp_method.relight.sky import Sky
from neilfpp_method.train.device import pick_device
from neilfpp_method.train.run import load_run
from neilfpp_method.view.address import check_free, only_here
from neilfpp_method.view.subject import Subject, subject_of

__all__ = ["Request", "view"]

MAPS = (".exr", ".hdr", ".png", ".jpg", ".jpeg")
LOOKED_EVERY = 2.0
"""Seconds between two looks for a new checkpoint."""
MIN_VERSION = 1
"""Major version of viser that the page is written for."""


@dataclass(frozen=True)
class Request:
    """What is asked for; the fields are those of `commands.view.View`, which says what they mean."""

    run: Path
    env: tuple[Path, ...]
    env_layout: Layout
    follow: bool
    host: str
    port: int
    resolution: int
    checkpoint: str
    device: str


def view(
    request: Request,
    say: Callable[[str], None] = lambda text: None,
    until: Callable[[float], bool] = lambda seconds: bool(time.sleep(seconds)),
) -> None:
    """Serve a run until a person stops the command.

    Args:
        request: what.
        say: takes lines for the person who waits.
        until: waits some seconds, and tells whether to end.

    Raises:
        UserError: something that was asked for cannot be.
    """
    check_viser()
    check_free(request.host, request.port)
    skies = _skies(request.env, request.env_layout)
    seen = _age(request)
    subject = None if request.follow and seen is None else _load(request)
    from neilfpp_method.view.browser import open_page

    skies = {
        name: replace(sky, radiance=sky.radiance.to(pick_device(request.device)))
        for name, sky in skies.items()
    }
    page = open_page(subject, skies, request.host, request.port, "neilfpp view")
    try:
        if not only_here(request.host):
            say(
                f"warning: anybody who reaches port {request.port} of this machine sees the run and its "
                "photographs"
            )
        if subject is None:
            say(f"waiting for the first checkpoint of {request.run}")
        elif subject.note:
            say(subject.note)
        say(f"open http://{_named(request.host)}:{request.port} in a browser; Ctrl-C ends")
        while not until(LOOKED_EVERY):
            age = _age(request) if request.follow else seen
            if age != seen:
                seen = age
                page.show(_load(request))
    finally:
        page.stop()


def check_viser() -> None:
    """That the library of the page is installed.

    Raises:
        UserError: it is not, or is too old.
    """
    remedy = "install it with: pip install 'neilfpp-method[view]'"
    try:
        version = metadata.version("viser")
    except metadata.PackageNotFoundError as error:
        raise UserError("neilfpp view needs viser, which is not installed", remedy) from error
    if int(version.split(".")[0]) < MIN_VERSION:
        raise UserError(f"neilfpp view needs viser {MIN_VERSION} or newer, {version} is installed", remedy)


def _load(request: Request) -> Subject:
    run = load_run(request.run, pick_device(request.device), request.checkpoint)
    return subject_of(run, request.resolution)


def _age(request: Request) -> int | None:
    """When the checkpoint was written; none: there is none."""
    path = request.run / "checkpoints" / f"{request.checkpoint}.pt"
    return path.stat().st_mtime_ns if path.is_file() else None


def _skies(given: Sequence[Path], layout: Layout) -> dict[str, Sky]:
    paths = [inner for path in given for inner in (_maps_in(path) if path.is_dir() else [path])]
    for path in paths:
        check_map(path)
    return {name: read_map(path, layout).sky for name, path in zip(map_names(paths), paths, strict=True)}


def _maps_in(folder: Path) -> list[Path]:
    maps = sorted(path for path in folder.iterdir() if path.suffix.lower() in MAPS)
    if not maps:
        raise UserError(f"{folder}: no environment maps in this folder", "give EXR or HDR files with --env")
    return maps


def _named(host: str) -> str:
    return "localhost" if host in ("0.0.0.0", "::") else f"[{host}]" if ":" in host else host
