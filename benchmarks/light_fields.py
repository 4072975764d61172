"""How well a light field fits the true light in a given time: the paper's network and the factorised field.

    python -m benchmarks.light_fields DATA/tabletop_env DATA/tabletop_mix --out docs

Each field is fitted to the true incident radiance at three of four points and three of four directions, by the mean
|ln L − ln L_true|. The same error is then taken on the other directions at those points, and at the points left out. The clock
counts one CPU thread's own time and stops while the error is taken. Per step every field sees all points with 128 directions
each: their own, or those above their horizon of 256 that all points share.

A second table has the time of one pair of a point and a direction, with its gradient.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from jaxtyping import Bool, Float
from rich.console import Console
from torch import Tensor

from benchmarks.charts import Chart, Line, draw_charts
from benchmarks.measure import Measurement, hardware, in_yardsticks, median_seconds
from benchmarks.true_light import TrueLight, read_light, true_light
from neilfpp_method.config import IncidentLightConfig
from neilfpp_method.data.truth import LightField
from neilfpp_method.fields.factorised_light import FactorisedLightField
from neilfpp_method.fields.free_light import make_incident_light
from neilfpp_method.fields.incident_light import IncidentLightField
from neilfpp_method.presets import paper_mlp
from neilfpp_method.shading.frame import dot
from neilfpp_method.shading.sampling import shared_sphere

__all__ = ["KINDS", "Field", "Kind", "Split", "fit", "log_error", "measurements", "pair_seconds", "relative_error", "split"]

DIRECTIONS = 128  # per point and step, as in the paper's presets
LEFT_OUT = 4  # every fourth point and direction
FLOOR = 1e-3  # radiance added before a logarithm, as in the metrics
RELATIVE_FLOOR = 0.05  # radiance added to the estimate that an error is divided by
FINAL_RATE = 0.05
Field = IncidentLightField | FactorisedLightField
Error = Callable[[Tensor, Tensor], Tensor]


@dataclass
class Options:
    """Fit light fields to captures whose light is known."""

    captures: tyro.conf.Positional[tuple[Path, ...]]
    """Folders of captures."""
    seconds: tuple[float, ...] = (2.5, 5.0, 10.0, 20.0, 40.0)
    """When the error is taken; the learning rate falls until the last."""
    out: Path = Path("runs/benchmarks")
    """Where the figure and the table go."""


@dataclass(frozen=True)
class Kind:
    """A field, whether points share their directions in training, and the rate that suits it."""

    config: IncidentLightConfig
    shared: bool
    rate: float


MLP = paper_mlp().light
FACTORISED = dataclasses.replace(MLP, network="factorised")
KINDS: Mapping[str, Kind] = {
    "paper's MLP": Kind(MLP, shared=False, rate=5e-4),
    "MLP, shared directions": Kind(MLP, shared=True, rate=5e-4),
    "factorised": Kind(FACTORISED, shared=False, rate=5e-3),
    "factorised, shared": Kind(FACTORISED, shared=True, rate=5e-3),
}


@dataclass(frozen=True)
class Split:
    """A true light field, what of it is fitted, and a function that stands for that part."""

    field: LightField
    points: Bool[Tensor, " N"]
    directions: Bool[Tensor, " S"]
    fitted: TrueLight


@dataclass(frozen=True)
class Fit:
    """A fitted field, its error over seconds of fitting, and how many steps they held."""

    net: Field
    directions: Line
    points: Line
    steps: int


def split(field: LightField) -> Split:
    """Three of four points and directions for the fit."""
    points, directions = (torch.arange(size) % LEFT_OUT != LEFT_OUT - 1 for size in field.wi.shape[:2])
    known = true_light(field.wi[points][:, directions], field.incident[points][:, directions])
    return Split(field, points, directions, known)


def fit(kind: Kind, data: Split, marks: tuple[float, ...], error: Error) -> Fit:
    """Fit a field by an error and take its `log_error` at the marks, seconds of the thread's own time."""
    torch.manual_seed(0)
    start = data.field.incident[data.points].median().item()
    net = make_incident_light(kind.config, 10.0, max(start, FLOOR))
    optimizer = torch.optim.Adam(net.parameters(), lr=kind.rate)
    seconds, steps, errors = 0.0, 0, []
    while len(errors) < len(marks):
        began = time.process_time()
        for group in optimizer.param_groups:
            group["lr"] = kind.rate * FINAL_RATE ** min(seconds / marks[-1], 1.0)
        loss = _loss(net, kind, data, error)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        seconds, steps = seconds + time.process_time() - began, steps + 1
        while len(errors) < len(marks) and seconds >= marks[len(errors)]:
            errors.append((_error(net, data, data.points, ~data.directions), _error(net, data, ~data.points, data.directions)))
    directions, points = zip(*errors, strict=True)
    return Fit(net, Line(marks, directions), Line(marks, points), steps)


def log_error(estimate: Tensor, truth: Tensor) -> Float[Tensor, ""]:
    """Mean |Δ ln L|: finds the median, so what is bright and small counts little."""
    return (_log(estimate) - _log(truth)).abs().mean()


def relative_error(estimate: Tensor, truth: Tensor) -> Float[Tensor, ""]:
    """Mean square of ΔL over the estimate: finds the mean, lamps included (Lehtinen et al. 2018)."""
    return ((estimate - truth) / (estimate.detach() + RELATIVE_FLOOR)).square().mean()


def _loss(net: Field, kind: Kind, data: Split, error: Error) -> Float[Tensor, ""]:
    """The error over a step's pairs."""
    x, normal = data.field.position[data.points], data.field.normal[data.points]
    if kind.shared:
        wi = shared_sphere(x, 2 * DIRECTIONS, stochastic=True).wi
        every = wi.expand(len(x), -1, -1)
        asked = dot(every, normal) > 0
        return error(net.radiance(x, wi, asked)[asked], data.fitted.radiance(every)[asked])
    known = torch.nonzero(data.directions)[:, 0]
    chosen = known[torch.randint(len(known), (len(x), DIRECTIONS))]
    rows = torch.nonzero(data.points)[:, :1]
    return error(net.radiance(x, data.field.wi[rows, chosen]), data.field.incident[rows, chosen])


@torch.no_grad()
def _error(net: Field, data: Split, points: Bool[Tensor, " N"], directions: Bool[Tensor, " S"]) -> float:
    """Mean |Δ ln L| over some points and, of some directions, every third."""
    wi, truth = (t[points][:, directions][:, ::3] for t in (data.field.wi, data.field.incident))
    return log_error(net.radiance(data.field.position[points], wi), truth).item()


def _log(radiance: Tensor) -> Tensor:
    return (radiance + FLOOR).log()


def pair_seconds(points: int = 64, repetitions: int = 5) -> dict[str, float]:
    """Seconds for a pair above the horizon, forward and backward, by kind."""
    queries = [_query(kind, points) for kind in KINDS.values()]
    seconds = median_seconds(*queries, repetitions=repetitions)
    return {name: taken / (points * DIRECTIONS) for name, taken in zip(KINDS, seconds, strict=True)}


def _query(kind: Kind, points: int) -> Callable[[], None]:
    """Radiance and its gradient for so many points and 128 directions each."""
    torch.manual_seed(0)
    x, normal = torch.rand(points, 3) - 0.5, torch.nn.functional.normalize(torch.randn(points, 3), dim=-1)
    net = make_incident_light(kind.config, math.e, 1.0)
    shared = shared_sphere(normal, 2 * DIRECTIONS, stochastic=False).wi
    own = torch.nn.functional.normalize(torch.randn(points, DIRECTIONS, 3), dim=-1)
    asked = dot(shared.expand(points, -1, -1), normal) > 0

    def run() -> None:
        radiance = net.radiance(x, shared, asked) if kind.shared else net.radiance(x, own)
        radiance.mean().backward()

    return run


def measurements() -> Iterator[Measurement]:
    """How much less than in the paper's network a pair costs, and the paper's pair in yardsticks."""
    seconds = pair_seconds(points=256, repetitions=9)
    paper = next(iter(seconds.values()))
    for name, taken in list(seconds.items())[1:]:
        yield Measurement(f"light/pair: paper's MLP over {name}", paper / taken, "×", "higher", tolerance=1.0)
    kind = next(iter(KINDS.values()))
    taken = in_yardsticks(_query(kind, 64), repetitions=5)
    yield Measurement("light/64 × 128 pairs: paper's MLP", taken, "yardsticks", "lower", tolerance=0.5)


def table(fits: Mapping[str, Fit]) -> str:
    """Markdown: error on directions left out / at points left out, by seconds."""
    marks = next(iter(fits.values())).directions.x
    head = ["", *(f"{mark:g} s" for mark in marks), "steps"]
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    for name, fitted in fits.items():
        cells = [f"{a:.3f} / {b:.3f}" for a, b in zip(fitted.directions.y, fitted.points.y, strict=True)]
        lines.append("| " + " | ".join([name, *cells, str(fitted.steps)]) + " |")
    return "\n".join(lines)


def main(options: Options) -> None:
    """Fit, print the tables, write them and the figure."""
    options.out.mkdir(parents=True, exist_ok=True)
    pairs = pair_seconds()
    first = next(iter(pairs.values()))
    lines = ["| | a pair, forward and backward | faster than the first |", "|---|---|---|"]
    lines += [f"| {name} | {1e6 * seconds:.2f} µs | {first / seconds:.1f} × |" for name, seconds in pairs.items()]
    sections, charts = [hardware(), "\n".join(lines)], []
    for capture in options.captures:
        data = split(read_light(capture))
        fits = {name: fit(kind, data, options.seconds, log_error) for name, kind in KINDS.items()}
        sections.append(f"### {capture.name}\n\n{table(fits)}")
        charts.append(Chart(f"{capture.name}: directions left out", {name: f.directions for name, f in fits.items()}))
        charts.append(Chart(f"{capture.name}: points left out", {name: f.points for name, f in fits.items()}))
    text = "\n\n".join(sections)
    (options.out / "light_fields.md").write_text(text + "\n")
    title = "Light fields fitted to the true light"
    draw_charts(options.out / "light_fields.png", title, "seconds of one thread", "mean |log error|", charts, columns=2)
    Console().print(text, markup=False, highlight=False, soft_wrap=True)


if __name__ == "__main__":
    main(tyro.cli(Options))
