"""Cost of finding the surface: queries of G per ray by the error-bounded sampler, on whole rays and with
skipping of empty space.

    python -m benchmarks sampler

The scene is the table of `benchmarks.joint` with the grid of `fast`, with the samples and rounds of the
paper's presets. The queries with skipping include the one per ray that checks the grid, and the ray's share
of the sampling of the grid, which is done once in `MAX_LIFE` steps of 4096 rays.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import torch

from benchmarks.joint import SHARP, fitted_model, rays_at_the_table
from benchmarks.measure import Measurement, median_seconds
from neilfpp_method.hosts.volsdf import VolSdfHost
from neilfpp_method.kernels.process import computing_fast
from neilfpp_method.settings.plain import changed, to_dict
from neilfpp_method.settings.presets import free_light, preset
from neilfpp_method.structures import RayBatch
from neilfpp_method.volume.empty_space import MAX_LIFE, RESOLUTION
from neilfpp_method.volume.partition import sample_counts

__all__ = ["measurements", "queries_per_ray", "table_host"]

RAYS = 1024
WHOLE = "whole rays"
WAYS = {
    WHOLE: 128,
    "empty space skipped": 128,
    "empty space skipped, half the cuts": 64,
    "empty space skipped, a quarter of the cuts": 32,
}
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


def with_cuts(host: VolSdfHost, cuts: int) -> VolSdfHost:
    """The host with so many cuts per ray in the first and in further rounds; with skipping of empty space it
    uses half of the set number.
    """
    cuts = cuts if host.empty_space is None else 2 * cuts
    host.sample_counts = dataclasses.replace(host.sample_counts, cuts=cuts)
    return host
