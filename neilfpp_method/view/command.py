"""`neilfpp view`: load a run, and serve the page until the user stops the command."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib import metadata
from pathlib import Path

from neilfpp_method.errors import UserError
from neilfpp_method.export.mesh import check_resolution
from neilfpp_method.relight.maps import Layout, check_map, map_names, read_map
from neilfpp_method.relight.sky import Sky
from neilfpp_method.train.checkpoint import checkpoint_path
from neilfpp_method.train.device import pick_device
from neilfpp_method.train.run import load_run
from neilfpp_method.view.address import check_address, is_local
from neilfpp_method.view.subject import Subject, subject_of

__all__ = ["ViewRequest", "view"]

MAPS = (".exr", ".hdr", ".png", ".jpg", ".jpeg")
"""Suffixes of the environment maps that are read from a folder."""
POLL_SECONDS = 2.0
"""Seconds between two checks for a new checkpoint."""
MIN_VERSION = 1
"""Oldest supported major version of viser."""


@dataclass(frozen=True)
class ViewRequest:
    """Options of the command; `commands.view.View` documents the fields."""

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
    request: ViewRequest,
    say: Callable[[str], None] = lambda text: None,
    until: Callable[[float], bool] = lambda seconds: bool(time.sleep(seconds)),
) -> None:
    """Serve a run until the user stops the command.

    Args:
        request: options of the command.
        say: receives messages for the user, line by line.
        until: waits for some seconds, and returns whether to stop.

    Raises:
        UserError: an option is invalid, or viser is missing.
    """
    check_resolution(request.resolution)
    check_viser()
    check_address(request.host, request.port)
    skies = _skies(request.env, request.env_layout)
    loaded = _checkpoint_time(request)
    subject = None if request.follow and loaded is None else _load(request, say)
    # viser is optional, so it is imported only after check_viser.
    from neilfpp_method.view.browser import open_page

    device = pick_device(request.device)
    skies = {name: replace(sky, radiance=sky.radiance.to(device)) for name, sky in skies.items()}
    page = open_page(subject, skies, request.host, request.port, "neilfpp view")
    try:
        if not is_local(request.host):
            say(
                f"warning: everybody who can connect to port {request.port} of this machine can see the run "
                "and its photographs"
            )
        if subject is None:
            say(f"waiting for the first checkpoint of {request.run}")
        elif subject.note:
            say(subject.note)
        say(f"open http://{_url_host(request.host)}:{request.port} in a browser; press Ctrl-C to stop")
        while not until(POLL_SECONDS):
            written = _checkpoint_time(request) if request.follow else loaded
            if written != loaded:
                loaded = written
                page.show(_load(request, say))
    finally:
        page.stop()


def check_viser() -> None:
    """Check that viser is installed.

    Raises:
        UserError: it is not installed, or too old.
    """
    remedy = "install it with: pip install 'neilfpp-method[view]'"
    try:
        version = metadata.version("viser")
    except metadata.PackageNotFoundError as error:
        raise UserError("neilfpp view needs viser, which is not installed", remedy) from error
    if int(version.split(".")[0]) < MIN_VERSION:
        raise UserError(
            f"neilfpp view needs viser {MIN_VERSION} or newer, but {version} is installed", remedy
        )


def _load(request: ViewRequest, say: Callable[[str], None]) -> Subject:
    run = load_run(request.run, pick_device(request.device), request.checkpoint)
    if request.follow:
        # Every checkpoint has another surface, so none is worth keeping.
        return subject_of(run, request.resolution, keep=False)
    return subject_of(run, request.resolution, say)


def _checkpoint_time(request: ViewRequest) -> int | None:
    """Time at which the checkpoint was written, ns; None if there is no checkpoint."""
    path = checkpoint_path(request.run, request.checkpoint)
    return path.stat().st_mtime_ns if path.is_file() else None


def _skies(files_or_folders: Sequence[Path], layout: Layout) -> dict[str, Sky]:
    """Read environment maps by name; a folder stands for all maps in it."""
    paths = [file for path in files_or_folders for file in (_maps_in(path) if path.is_dir() else [path])]
    for path in paths:
        check_map(path)
    return {name: read_map(path, layout).sky for name, path in zip(map_names(paths), paths, strict=True)}


def _maps_in(folder: Path) -> list[Path]:
    maps = sorted(path for path in folder.iterdir() if path.suffix.lower() in MAPS)
    if not maps:
        raise UserError(f"{folder}: no environment maps in this folder", "give EXR or HDR files with --env")
    return maps


def _url_host(host: str) -> str:
    """The host part of the URL to open."""
    if host in ("0.0.0.0", "::"):
        return "localhost"
    # IPv6 addresses are written in brackets.
    return f"[{host}]" if ":" in host else host
