"""Error of the shading integral against the number of incident directions, on the true light of captures.

    python -m benchmarks.shading_samples DATA/tabletop_env DATA/tabletop_mix --out docs

At the points of the true light field, seen from some of its directions, the surface has its true colour and
metallicity and one roughness after another. Every sampler estimates the same integral, of METHOD §1's BRDF
and the true light interpolated between its 4096 directions; the reference is the same estimator with 9216
directions of all techniques together. The error is the root of the mean square over points, views, channels
and repetitions, divided by that of the reference.

`mis` is measured with an environment map as well: the mean of the light that arrives at all points, which is
what training can find out about it. The other samplers do not depend on the light.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import torch
import tyro
from jaxtyping import Float
from rich.console import Console
from torch import Tensor

from benchmarks.charts import Chart, Line, draw_charts
from benchmarks.command import run_benchmark
from benchmarks.measure import Measurement, hardware, in_yardsticks
from benchmarks.true_light import TrueLight, read_light, true_light
from neilfpp_method.data.truth import LightField
from neilfpp_method.demo.command import demo_scene
from neilfpp_method.fields.direction_map import map_directions
from neilfpp_method.fields.environment import EnvironmentLight
from neilfpp_method.shading.brdf import SPHERICAL_GAUSSIAN
from neilfpp_method.shading.rendering_equation import shade
from neilfpp_method.shading.sampling import (
    Sampling,
    Technique,
    combine,
    cosine,
    sample_directions,
    specular_lobe,
)
from neilfpp_method.structures import Incident, IncidentSamples, Material

__all__ = ["Scene", "error_curves", "measurements", "scene_of", "techniques"]

COUNTS = (8, 16, 32, 64, 128, 256)
ROUGHNESS = (0.05, 0.1, 0.2, 0.35, 0.5, 0.7, 1.0)
VIEWS = 4
REPETITIONS = 4
MAP_ROWS = 16
REFERENCE = 3072  # directions of each of three techniques
LOBE = SPHERICAL_GAUSSIAN


@dataclass
class Options:
    """Measure the samplers on captures whose light is known."""

    captures: tyro.conf.Positional[tuple[Path, ...]]
    """Folders of captures."""
    out: Path = Path("runs/benchmarks")
    """Folder for the figure and the table."""


@dataclass(frozen=True)
class Scene:
    """M pairs of a point and a view, with the light at each point, and a map of the mean light."""

    normal: Float[Tensor, "M 3"]
    wo: Float[Tensor, "M 3"]
    material: Material
    light: TrueLight
    map: EnvironmentLight

    def with_roughness(self, roughness: float) -> Material:
        """The material with another roughness, the same at all points."""
        return replace(self.material, roughness=torch.full_like(self.material.roughness, roughness))

    def shade(self, roughness: float, samples: IncidentSamples) -> Float[Tensor, "M 3"]:
        """Estimate of the outgoing radiance of a surface with this roughness."""
        incident = Incident.of(samples, self.light.radiance(samples.wi))
        return shade(self.with_roughness(roughness), self.normal, self.wo, incident, LOBE).color

    def lobe(self, roughness: float) -> Technique:
        return specular_lobe(self.normal, self.wo, self.with_roughness(roughness).roughness, LOBE)

    def to_light(self) -> Technique:
        """Sampling of the map times the cosine."""
        return self.map.technique(self.normal)


Draw = Callable[[Scene, float, int], IncidentSamples]


@torch.no_grad()
def scene_of(field: LightField, views: int = VIEWS) -> Scene:
    """The true light field of a capture, viewed from the first of its directions."""
    light = true_light(field.wi, field.incident)
    rows = torch.arange(len(field.position)).repeat_interleave(views)
    wo = field.wo[:, :views].reshape(-1, 3)
    return Scene(field.normal[rows], wo, field.material[rows], light[rows], _mean_map(field, light))


def _mean_map(field: LightField, light: TrueLight) -> EnvironmentLight:
    """Mean of the light over the points for which a direction is above the horizon."""
    mean = EnvironmentLight(MAP_ROWS, 1.0)
    wi = map_directions(*mean.log_radiance.shape[1:]).to(field.normal)
    above = (field.normal @ wi.reshape(-1, 3).T > 0)[..., None]
    radiance = light.radiance(wi.reshape(1, -1, 3).expand(len(field.normal), -1, -1)) * above
    mean.show((radiance.sum(0) / above.sum(0).clamp_min(1)).T.reshape(mean.log_radiance.shape))
    return mean


def techniques() -> dict[str, Draw]:
    """The compared samplers by name; the first is the paper's."""

    def plain(kind: str) -> Draw:
        return lambda scene, roughness, count: sample_directions(
            Sampling(kind, count, LOBE, stochastic=True),
            scene.normal,
            scene.wo,
            scene.with_roughness(roughness),
        )

    def with_light(scene: Scene, roughness: float, count: int) -> IncidentSamples:
        sampling, material = Sampling("mis", count, LOBE, stochastic=True), scene.with_roughness(roughness)
        return sample_directions(sampling, scene.normal, scene.wo, material, scene.to_light())

    return {kind: plain(kind) for kind in ("fibonacci", "cosine", "lobe", "mis")} | {
        "mis, light: map": with_light
    }


@torch.no_grad()
def error_curves(
    scene: Scene, roughness: float, draws: Mapping[str, Draw], counts: tuple[int, ...] = COUNTS
) -> dict[str, Line]:
    """Relative root mean square error over the number of directions, by sampler."""
    parts = [cosine(scene.normal), scene.lobe(roughness), scene.to_light()]
    samples = combine([(part, REFERENCE) for part in parts], stochastic=True)
    truth = scene.shade(roughness, samples)
    size = truth.square().mean().sqrt()
    lines = {}
    for name, draw in draws.items():
        errors = []
        for count in counts:
            estimates = [scene.shade(roughness, draw(scene, roughness, count)) for _ in range(REPETITIONS)]
            mean_square = torch.stack([(estimate - truth).square().mean() for estimate in estimates]).mean()
            errors.append((mean_square.sqrt() / size).item())
        lines[name] = Line(counts, errors)
    return lines


def measurements() -> Iterator[Measurement]:
    """The error of 32 directions with a map over that of Fibonacci-128, and the time of the integral."""
    torch.manual_seed(0)
    scene = scene_of(read_light(demo_scene()))
    draws = techniques()
    paper, best = draws["fibonacci"], draws["mis, light: map"]
    for roughness in (0.1, 0.35, 1.0):
        few = error_curves(scene, roughness, {"": best}, counts=(32,))[""].y[0]
        many = error_curves(scene, roughness, {"": paper}, counts=(128,))[""].y[0]
        yield Measurement(
            f"shading/error of 32 over Fibonacci-128, roughness {roughness:g}", few / many, "×", "lower", 1.0
        )
    for name, draw, count in (("Fibonacci-128", paper, 128), ("32 by mis with light", best, 32)):

        def integrate(draw: Draw = draw, count: int = count) -> None:
            scene.shade(0.35, draw(scene, 0.35, count))

        taken = in_yardsticks(integrate, repetitions=21)  # milliseconds, which a busy machine stretches most
        yield Measurement(f"shading/256 points, {name}", taken, "yardsticks", "lower", tolerance=1.0)


def table(curves: Mapping[float, Mapping[str, Line]]) -> str:
    """Markdown: by roughness, the error of Fibonacci-128, that of each sampler with 32 directions, and the
    least number of directions with which the last sampler reaches the first.
    """
    names = list(next(iter(curves.values())))
    head = [
        "roughness",
        f"{names[0]}, 128",
        *(f"{name}, 32" for name in names[1:]),
        "least directions of the last",
    ]
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    for roughness, by_name in curves.items():
        goal = _at(by_name[names[0]], 128)
        last = by_name[names[-1]]
        least = next((str(count) for count, error in zip(last.x, last.y, strict=True) if error <= goal), "–")
        cells = [
            f"{roughness:g}",
            f"{goal:.3f}",
            *(f"{_at(by_name[name], 32):.3f}" for name in names[1:]),
            least,
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _at(line: Line, count: int) -> float:
    return line.y[list(line.x).index(count)]


def main(options: Options) -> None:
    """Measure, print the tables, write them and the figure."""
    options.out.mkdir(parents=True, exist_ok=True)
    torch.manual_seed(0)
    sections, charts = [hardware()], []
    for capture in options.captures:
        field = read_light(capture)
        scene = scene_of(field)
        curves = {roughness: error_curves(scene, roughness, techniques()) for roughness in ROUGHNESS}
        sections.append(f"### {capture.name}\n\n{table(curves)}\n")
        charts += [Chart(f"{capture.name}, roughness {r:g}", curves[r]) for r in (0.1, 0.35, 1.0)]
    text = "\n\n".join(sections)
    (options.out / "shading_samples.md").write_text(text + "\n")
    title = "The shading integral: what a direction is worth"
    draw_charts(
        options.out / "shading_samples.png", title, "incident directions", "relative RMSE", charts, columns=3
    )
    Console().print(text, markup=False, highlight=False, soft_wrap=True)


if __name__ == "__main__":
    run_benchmark(lambda: main(tyro.cli(Options)))
