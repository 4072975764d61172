"""The options of `neilfpp relight`, and the checks that need no run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from neilfpp_method.errors import UserError
from neilfpp_method.export.mesh import check_resolution
from neilfpp_method.relight.denoise import check_denoiser
from neilfpp_method.relight.edits import parse_edits
from neilfpp_method.relight.film import Budget
from neilfpp_method.relight.lamp_edits import parse_lamp_edits
from neilfpp_method.relight.maps import Layout, check_map, map_names

__all__ = ["RelightRequest", "check_request"]

TURNTABLE = "turntable"
"""The word for a circle of cameras in place of views."""
SAMPLES = 64
"""Default number of samples per pixel, if neither --spp nor --seconds is given."""
MAX_EXPOSURE = 64
"""Largest change of the exposure, in stops; float32 holds 254."""
MAX_BOUNCES = 64
"""Largest number of bounces, after which a path carries less than a thousandth of its radiance."""


@dataclass(frozen=True)
class RelightRequest:
    """Options of the command, with its defaults; `commands.relight.Relight` documents the fields."""

    run: Path
    env: tuple[Path, ...] = ()
    env_layout: Layout = "ours"
    rotate: float = 0.0
    exposure: float = 0.0
    lamps: str = "auto"
    lamp_edits: tuple[str, ...] = ()
    views: tuple[str, ...] = ("test",)
    frames: int | None = None
    edits: tuple[str, ...] = ()
    box: tuple[float, ...] | None = None
    mask: tuple[Path, ...] = ()
    spp: int | None = None
    seconds: float | None = None
    bounces: int = 6
    scale: float | None = None
    width: int | None = None
    background: str = "transparent"
    denoise: bool = False
    truth: tuple[Path, ...] = ()
    out: Path | None = None
    resolution: int = 512
    force: bool = False
    checkpoint: str = "last"
    device: str = "auto"

    @property
    def is_turntable(self) -> bool:
        """Whether a circle of cameras is rendered in place of views."""
        return TURNTABLE in self.views

    @property
    def budget(self) -> Budget:
        """The limits per image, with the default number of samples if the options set no limit."""
        return Budget(self.spp or (SAMPLES if self.seconds is None else None), self.seconds)

    @property
    def lights_lamps(self) -> bool:
        """Whether the run's lamps are lit: if requested, and by default under the run's own light."""
        requested = self.lamps == "keep" or bool(self.lamp_edits)
        return requested or (self.lamps == "auto" and not self.env)


def check_request(request: RelightRequest) -> None:
    """Check everything that does not need the run.

    Raises:
        UserError: an option is invalid, or options exclude each other.
    """
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
    circle, sized = request.is_turntable, request.scale is not None or request.width is not None
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
    if request.frames is not None and not circle:
        raise UserError("--frames without --views turntable has no effect", "add --views turntable")
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
