"""What finding the surface costs: queries of G per ray, by the error-bounded sampler on whole rays and on what is not empty.

    python -m benchmarks sampler

The table of `benchmarks.joint` behind the grid of `fast`, with the samples and rounds of the paper's presets. Queries of the
cached path include the one per ray that tests the grid's promise, and the ray's share of the grid, which is sampled once in
`MOST_LIFE` steps of 4096 rays.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import torch

from benchmarks.joint import SHARP, fitted_model, rays_at_the_table
from benchmarks.measure import Measurement, median_seconds
from neilfpp_method.hosts.volsdf import VolSdfHost
from neilfpp_method.kernels.process import computing_fast
from neilfpp_method.presets import free_light, preset
from neilfpp_method.structures import RayBatch
from neilfpp_method.volume.empty_space import MOST_LIFE, RESOLUTION

__all__ = ["measurements", "queries_per_ray", "table_host"]

RAYS = 1024
SCALES = (0.03, 0.01, SHARP)  # of the density: a surface that is found, one that settles, one that has


def table_host(skip_empty: bool = True) -> VolSdfHost:
    """The host of the scene, with the paper's sampler."""
    paper, small = preset("paper-ngp").volume, free_light(preset("fast"))
    volume = dataclasses.replace(paper, radius=small.volume.radius, skip_empty=skip_empty)
    return fitted_model(dataclasses.replace(small, volume=volume)).host.train()


def queries_per_ray(host: VolSdfHost, rays: RayBatch) -> float:
    """How often G is asked for a distance alone, per ray of a rendering; the grid of empty space is there already."""
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
    """Queries per ray by the scale of the density, and the time of rendering without gradients."""
    rays = rays_at_the_table(RAYS).rays
    share_of_grid = RESOLUTION**3 / (MOST_LIFE * preset("paper-ngp").train.rays)
    with computing_fast():
        whole, cached = table_host(skip_empty=False), table_host()
        for scale in SCALES:
            for host in (whole, cached):
                host.density.above_floor.data.fill_(scale - host.density.beta_floor)
            cached.may_meet(rays)  # samples the grid
            exact, fewer = queries_per_ray(whole, rays), queries_per_ray(cached, rays) + share_of_grid
            yield Measurement(f"sampler/β {scale:g}: whole rays", exact, "queries a ray", "lower", tolerance=0.2)
            yield Measurement(f"sampler/β {scale:g}: empty space skipped", fewer, "queries a ray", "lower", tolerance=0.2)
        with torch.no_grad():
            slow, fast = median_seconds(lambda: whole.render(rays), lambda: cached.render(rays))
        yield Measurement(f"sampler/β {SHARP:g}: time of whole rays over skipped", slow / fast, "×", "higher", tolerance=0.5)
