"""The evidence for lamps before the environment map, fit by fit, in `RUN/light.json`."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from neilfpp_method.errors import UserError
from neilfpp_method.lighting.fit import MIN_POINTS, Evidence
from neilfpp_method.settings.plain import from_dict
from neilfpp_method.settings.types import FreeLightConfig, MapLightConfig
from neilfpp_method.train.run import read_json, write_json

__all__ = ["LightFit", "in_words", "note_fit", "read_fits", "write_fits"]

FORMAT = 1
FILE = "light.json"


@dataclass(frozen=True)
class LightFit:
    """What one fit of the light found.

    Attributes:
        step: of the training.
        gain: how much lower the mean relative error is with lamps, at points that were kept back from the
            fit.
        deviation: the standard error of that mean.
        points: how many were kept back.
        lamps: how many are lit since.
    """

    step: int
    gain: float
    deviation: float
    points: int
    lamps: int


def note_fit(fits: list[LightFit], found: Evidence | None, lamps: int, step: int) -> None:
    """Add what a fit measured for and against lamps, where it did, and how many are lit since."""
    if found is not None:
        fits.append(LightFit(step, found.gain, found.deviation, found.points, lamps))


def write_fits(run: Path, fits: Sequence[LightFit]) -> None:
    """The record into the run's folder, where there is anything to record."""
    if fits:
        write_json(run / FILE, {"format": FORMAT, "fits": [dataclasses.asdict(fit) for fit in fits]})


def read_fits(run: Path, before: int) -> list[LightFit]:
    """The record of a run up to a step; empty where the light was never fitted both ways.

    Raises:
        UserError: the file is damaged or of another version.
    """
    path = run / FILE
    if not path.is_file():
        return []
    stored = read_json(path)
    if stored.get("format") != FORMAT or not isinstance(stored.get("fits"), list):
        raise UserError(
            f"{path}: a record of another version", "remove the file, or use the version that wrote it"
        )
    try:
        fits = [from_dict(LightFit, fit, str(path)) for fit in stored["fits"]]
    except (TypeError, AttributeError) as error:  # Something that must be there is missing, or is no object.
        raise UserError(
            f"{path}: not a complete record ({error})", "remove the file, or train again"
        ) from error
    return [fit for fit in fits if fit.step < before]


def in_words(config: FreeLightConfig | MapLightConfig, fits: Sequence[LightFit]) -> str:
    """The light that a run came to, and why, in one line; without a reason where the settings had decided."""
    if isinstance(config, FreeLightConfig):
        return "a field that is free at every point"
    sky = "an environment map" if config.map is None else "the given environment map"
    if not fits:
        return f"{sky} and lamps before it" if config.kind == "distant_near" else sky
    last = fits[-1]
    if last.points < MIN_POINTS:
        return f"{sky}; {last.points} points kept back are too few to say anything of lamps"
    change = f"error {-100 * last.gain:+.1f} ± {100 * last.deviation:.1f} % at {last.points} points kept back"
    change = change.replace("-", "\N{MINUS SIGN}")
    if last.lamps:
        return f"{sky} and {last.lamps} lamp{'s' if last.lamps > 1 else ''} before it ({change})"
    return f"{sky}; lamps were not needed ({change})"
