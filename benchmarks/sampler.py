"""Cost of finding the surface: queries of G per ray by the error-bounded sampler, on whole rays and with
skipping of empty space; and, with the entering density, accuracy and time of its sampler against that one.

    python -m benchmarks sampler

The scene is the table of `benchmarks.joint` with the grid of `fast`, with the samples and rounds of the
paper's presets. The queries with skipping include the one per ray that checks the grid, and the ray's share
of the sampling of the grid, which is done once in `MAX_LIFE` steps of 4096 rays.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.joint import SHARP, fitted_model, rays_at_the_table
from benchmarks.measure import Measurement, device, median_seconds
from neilfpp_method.hosts.volsdf import VolSdfHost
from neilfpp_method.kernels.process import computing_fast
from neilfpp_method.settings.facts import SceneFacts
from neilfpp_method.settings.plain import changed, to_dict
from neilfpp_method.settings.presets import free_light, preset
from neilfpp_method.structures import RayBatch
from neilfpp_method.volume.empty_space import MAX_LIFE, RESOLUTION
from neilfpp_method.volume.intersect import Interval
from neilfpp_method.volume.partition import SampleCounts, sample_counts
from neilfpp_method.volume.samplers import error_bounded_samples

__all__ = ["measurements", "queries_per_ray", "table_host"]

RAYS = 1024
WHOLE = "whole rays"
WAYS = {
    WHOLE: 128,
    "empty space skipped": 128,
    "empty space skipped, half the cuts": 64,
    "empty space skipped, a quarter of the cuts": 32,
}
ENTERING, BOUNDED = "its own sampler", "VolSDF's sampler"
SCALES = (0.03, 0.01, SHARP)  # of the density: a surface that is found, one that settles, one that has


def table_host(skip_empty: bool = True) -> VolSdfHost:
    """The host of the scene, with the paper's sampler."""
    paper, small = preset("paper-ngp").host.volume, free_light(preset("fast"))
    volume = {**to_dict(paper), "skip_empty": skip_empty}
    host = fitted_model(changed(small, {"host.volume": volume})).host.train()
    host.sample_counts = sample_counts(paper)
    return host


def queries_per_ray(host: VolSdfHost, rays: RayBatch) -> float:
    """Number of queries of only the distance, per rendered ray; the grid of empty space is sampled before."""
    asked = []
    plain = host.sdf
    host.sdf = lambda x: asked.append(len(x)) or plain(x)
    try:
        with torch.no_grad():
            host.render(rays)
    finally:
        del host.sdf
    return sum(asked) / len(rays)


def measurements() -> Iterator[Measurement]:
    """By scale and method: queries, and the distance of hits from those of whole rays that are sampled
    without random numbers.
    """
    rays = rays_at_the_table(RAYS).rays
    share_of_grid = RESOLUTION**3 / (MAX_LIFE * preset("paper-ngp").train.rays)
    hosts = {name: with_cuts(table_host(name != WHOLE), cuts) for name, cuts in WAYS.items()}
    with computing_fast(), torch.no_grad():
        for scale in SCALES:
            for host in hosts.values():
                host.density.above_floor.fill_(scale - host.density.beta_floor)
            truth = hosts[WHOLE].eval().render(rays).position
            hosts[WHOLE].train()
            for name, host in hosts.items():
                host.may_hit(rays)  # samples the grid
                queries = queries_per_ray(host, rays) + (0 if name == WHOLE else share_of_grid)
                off = (host.render(rays).position - truth).norm(dim=-1).median().item() / scale
                yield Measurement(
                    f"sampler/β {scale:g}, {name}", queries, "queries a ray", "lower", tolerance=0.2
                )
                yield Measurement(
                    f"sampler/β {scale:g}, {name}: hit off", off, "β, median", "lower", tolerance=1.0
                )
        seconds = median_seconds(*(lambda host=host: host.render(rays) for host in hosts.values()))
        for name, taken in list(zip(WAYS, seconds, strict=True))[1:]:
            yield Measurement(
                f"sampler/β {SHARP:g}: time, whole over {name}",
                seconds[0] / taken,
                "×",
                "higher",
                tolerance=0.5,
            )
    yield from entering_measurements()


class BoundedHost(VolSdfHost):
    """The entering density with VolSDF's sampler, which knows nothing of it."""

    def _sample(self, rays: RayBatch, interval: Interval, counts: SampleCounts) -> Float[Tensor, "N M"]:
        beta = self.density.beta().detach()
        return error_bounded_samples(self.sdf, rays, interval, beta, counts, self.training).distances


def entering_measurements() -> Iterator[Measurement]:
    """With the settings of `fast` and the entering density: deviation of normals from those of 512 samples,
    mean over the rays, and time.
    """
    rays, config = rays_at_the_table(RAYS).rays, free_light(preset("fast"))
    config = changed(config, {"host.volume.density": "entering"})
    host = fitted_model(config).host.train()
    bounded = BoundedHost(host.config, SceneFacts("linear", 0.2, 3.0, "constant")).to(device()).train()
    bounded.load_state_dict(host.state_dict(), strict=False)
    hosts = {ENTERING: host, BOUNDED: bounded}
    with computing_fast(), torch.no_grad():
        for scale in SCALES:
            for either in hosts.values():
                either.density.above_floor.fill_(scale - either.density.beta_floor)
            host.sample_counts = dataclasses.replace(bounded.sample_counts, cuts=512, rendered=512)
            truth = host.eval().render(rays).normal
            host.train().sample_counts = bounded.sample_counts
            for name, either in hosts.items():
                cosine = (either.render(rays).normal * truth).sum(-1).clamp(-1.0, 1.0)
                off = torch.rad2deg(cosine.arccos()).mean().item()
                yield Measurement(
                    f"sampler/entering, β {scale:g}, {name}: normal off", off, "°", "lower", tolerance=0.5
                )
        slow, fast = median_seconds(
            *(lambda either=either: either.render(rays) for either in (bounded, host))
        )
        yield Measurement(
            f"sampler/entering, β {SHARP:g}: time, {BOUNDED} over {ENTERING}",
            slow / fast,
            "×",
            "higher",
            tolerance=0.5,
        )


def with_cuts(host: VolSdfHost, cuts: int) -> VolSdfHost:
    """The host with so many cuts per ray in the first and in further rounds; with skipping of empty space it
    uses half of the set number.
    """
    cuts = cuts if host.empty_space is None else 2 * cuts
    host.sample_counts = dataclasses.replace(host.sample_counts, cuts=cuts)
    return host
