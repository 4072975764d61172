"""How good a training is while it runs, by pixels that no step learns from (`data.held_back`): the record
`RUN/quality.json`.

A look renders them as evaluation renders test views, so its PSNR is that of `volume_psnr` and `pbr_psnr`:
clipped, encoded as sRGB. A look follows every tenth of a stage, `MIN_STEPS` steps after the last one at
least, and each stage ends with one. Looks that took more than `MAX_SHARE` of the run so far wait, but for
those at the ends of stages.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.errors import UserError
from neilfpp_method.model import NeilfModel
from neilfpp_method.schedule import StagePosition
from neilfpp_method.settings.plain import from_dict
from neilfpp_method.shading.color import tone_map
from neilfpp_method.structures import PixelBatch
from neilfpp_method.train.json_files import is_finite_number, read_json, write_json

__all__ = ["FILE", "Look", "Quality", "has_looks", "read_looks", "write_looks"]

FORMAT = 1
FILE = "quality.json"
LOOKS_OF_STAGE = 10
MIN_STEPS = 200
"""Steps between two looks of a stage, at least: a look is about as much work as a step."""
MAX_SHARE = 0.015
"""Of the time of a run that looks within stages take at most."""


@dataclass(frozen=True)
class Look:
    """What held-back pixels showed.

    Attributes:
        step: how many steps had been trained.
        stage: the one that these ended in.
        seconds: of the whole run, at the look.
        radiance: PSNR of R, dB.
        physical: PSNR of the rendering equation, dB; none before there is a material.
        took: seconds.
    """

    step: int
    stage: str
    seconds: float
    radiance: float
    physical: float | None
    took: float


@dataclass
class Quality:
    """The looks of a training so far.

    Attributes:
        pixels: that are held back; where a capture is too small for any, nothing is looked at.
        hdr: whether they are linear radiance; else display values.
    """

    pixels: PixelBatch
    hdr: bool
    looks: list[Look] = field(default_factory=list)

    def look_when_due(self, model: NeilfModel, position: StagePosition, step: int, seconds: float) -> None:
        """Look, if it is time.

        Args:
            model: comes back in the mode that it is in.
            position: how many steps of the stage are over, and how many it has.
            step: how many steps have been trained.
            seconds: of the whole run.
        """
        if not len(self.pixels) or not self._due(position, step, seconds):
            return
        began = time.perf_counter()
        radiance, physical = _decibels(
            model, self.pixels, model.stages[position.stage].moves_material, self.hdr
        )
        took = time.perf_counter() - began
        if not all(map(math.isfinite, (radiance, physical or 0.0))):
            return  # health says what is wrong with such a model
        self.looks.append(Look(step, position.stage.value, seconds, radiance, physical, took))

    def _due(self, position: StagePosition, step: int, seconds: float) -> bool:
        if position.step == position.length:
            return True
        before = max((look.step for look in self.looks), default=0)
        since = min(step - before, position.step)
        cheap = sum(look.took for look in self.looks) <= MAX_SHARE * seconds
        return cheap and since >= max(MIN_STEPS, math.ceil(position.length / LOOKS_OF_STAGE))


@torch.no_grad()
def _decibels(
    model: NeilfModel, pixels: PixelBatch, with_material: bool, hdr: bool
) -> tuple[float, float | None]:
    mode = model.training
    model.eval()
    maps = model.maps(pixels.rays, with_material)
    model.train(mode)
    photograph = tone_map(pixels.color) if hdr else pixels.color
    physical = _psnr(tone_map(maps.rgb), photograph) if with_material else None
    return _psnr(tone_map(maps.rgb_volume), photograph), physical


def _psnr(shown: Float[Tensor, "N 3"], photograph: Float[Tensor, "N 3"]) -> float:
    return -10.0 * math.log10(max(float((shown - photograph).square().mean()), 1e-10))


def write_looks(run: Path, quality: Quality) -> None:
    """The looks so far, and how many pixels they are of."""
    looks = [dataclasses.asdict(look) for look in quality.looks]
    write_json(run / FILE, {"format": FORMAT, "pixels": len(quality.pixels), "looks": looks})


def has_looks(run: Path) -> bool:
    """Whether a run holds pixels back."""
    return (run / FILE).exists()


def read_looks(run: Path, before: int | None = None) -> Sequence[Look]:
    """The looks of a run at its first `before` steps; none: all. Empty where the run has no record.

    Raises:
        UserError: the file is damaged or of another version.
    """
    path = run / FILE
    if not path.is_file():
        return []
    stored = read_json(path)
    if stored.get("format") != FORMAT or not isinstance(stored.get("looks"), list):
        raise UserError(
            f"{path}: a record of another version", "remove the file, or use the version that wrote it"
        )
    try:
        looks = [from_dict(Look, look, str(path)) for look in stored["looks"]]
    except (TypeError, AttributeError) as error:  # Something that must be there is missing, or is no object.
        raise UserError(
            f"{path}: not a complete record ({error})", "remove the file, or train again"
        ) from error
    if not all(
        is_finite_number(n) for look in looks for n in (look.seconds, look.radiance, look.physical or 0.0)
    ):
        raise UserError(f"{path}: a number that is not finite", "remove the file, or train again")
    return [look for look in looks if before is None or look.step <= before]
