"""The evidence for lamps at each fit of the light, stored in `RUN/light.json`."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from neilfpp_method.data.files.json_entry import write_json
from neilfpp_method.lighting.decision import MIN_SAMPLES
from neilfpp_method.lighting.fit import Evidence
from neilfpp_method.settings.types import FreeLightConfig, MapLightConfig
from neilfpp_method.train.json_files import read_entries

__all__ = ["LightFit", "light_summary", "note_fit", "read_fits", "write_fits"]

FORMAT = 1
FILE = "light.json"


@dataclass(frozen=True)
class LightFit:
    """The result of a fit of the light with and without lamps.

    Attributes:
        step: number of steps trained before the fit.
        gain: reduction of the mean relative error by lamps, at points held back from the fit.
        deviation: standard error of that mean.
        points: number of held-back points.
        lamps: number of lamps in use after the fit.
    """

    step: int
    gain: float
    deviation: float
    points: int
    lamps: int


def note_fit(fits: list[LightFit], evidence: Evidence | None, lamps: int, step: int) -> None:
    """Append the result of a fit to `fits` if it compared the light with and without lamps."""
    if evidence is not None:
        fits.append(LightFit(step, evidence.gain, evidence.deviation, evidence.points, lamps))


def write_fits(run: Path, fits: Sequence[LightFit]) -> None:
    """Write the results of the fits into the run folder if there are any."""
    if fits:
        write_json(run / FILE, {"format": FORMAT, "fits": [dataclasses.asdict(fit) for fit in fits]})


def read_fits(run: Path, before: int) -> list[LightFit]:
    """Read the results of the fits; empty if none compared the light with and without lamps.

    Args:
        run: the run folder.
        before: number of steps up to which fits are wanted.

    Raises:
        UserError: if the file is damaged or of another version.
    """
    fits = read_entries(run / FILE, FORMAT, "fits", LightFit) or []
    return [fit for fit in fits if fit.step <= before]


def light_summary(config: FreeLightConfig | MapLightConfig, fits: Sequence[LightFit]) -> str:
    """One line on the kind of light of a run, with the evidence unless the settings decide."""
    if isinstance(config, FreeLightConfig):
        return "a field that is free at every point"
    map_kind = "an environment map" if config.map is None else "the given environment map"
    if not fits:
        return f"{map_kind} and near lamps" if config.kind == "distant_near" else map_kind
    last = fits[-1]
    if last.points < MIN_SAMPLES:
        return f"{map_kind}; lamps were not decided on, with only {last.points} held-back points"
    size = f"{-100 * last.gain:+.1f} ± {100 * last.deviation:.1f} %".replace("-", "\N{MINUS SIGN}")
    change = f"error {size} at {last.points} held-back points"
    if last.lamps:
        return f"{map_kind} and {last.lamps} near lamp{'s' if last.lamps > 1 else ''} ({change} with lamps)"
    return f"{map_kind} without lamps ({change} with lamps)"
