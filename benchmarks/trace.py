"""Cost of a traced ray of L_ref: looked up in the grid and rendered only if it may hit, or always rendered.

    python -m benchmarks trace

Scene and settings are those of `benchmarks.sampler`: a table and two balls.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch

from benchmarks.joint import rays_at_the_table
from benchmarks.measure import Measurement, median_seconds
from benchmarks.sampler import table_host
from neilfpp_method.hosts.volsdf import VolSdfHost
from neilfpp_method.incident.traced import TracedLight, trace_light
from neilfpp_method.kernels.process import computing_fast
from neilfpp_method.settings.presets import preset
from neilfpp_method.structures import RayBatch

__all__ = ["measurements"]

POINTS = 1024
HIT_SHARE = 0.8


def measurements() -> Iterator[Measurement]:
    """Time per ray by both methods, the number of rendered rays, and the share of missed hits."""
    settings = preset("paper-ngp")  # one ray per point
    plain, cached = table_host(skip_empty=False), table_host()
    with torch.no_grad(), computing_fast():
        hits = plain.render(rays_at_the_table(POINTS).rays)
        rows = torch.nonzero(hits.is_hit(HIT_SHARE))[:, 0]
        points, normals = hits.position[rows], hits.normal[rows]

        def trace(host: VolSdfHost) -> TracedLight:
            torch.manual_seed(0)
            return trace_light(host, points, normals, settings)

        rays = _Recorder(plain)
        hit, chosen = trace(rays).hit, trace(cached)
        overlooked = (hit & ~cached.may_hit(rays.seen)).sum() / hit.sum()
        slow, fast = median_seconds(lambda: trace(plain), lambda: trace(cached))
    yield Measurement("trace/rays that hit", hit.float().mean().item(), "of rays", "higher")
    yield Measurement("trace/rays rendered", len(chosen.hit) / len(hit), "of rays", "lower", tolerance=0.2)
    yield Measurement("trace/hits overlooked", overlooked.item(), "of hits", "lower")
    yield Measurement("trace/a ray, rendered anyway", 1e6 * slow / len(hit), "µs", "lower")
    yield Measurement("trace/rendered anyway over looked up first", slow / fast, "×", "higher", tolerance=0.5)


class _Recorder:
    """A host that records the rays that it renders."""

    def __init__(self, host: VolSdfHost) -> None:
        self.host, self.surface_width = host, host.surface_width

    def render(self, rays: RayBatch):
        self.seen = rays
        return self.host.render(rays)
