"""From paths to a picture: samples are added pass by pass, until there are enough or the time is over."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.data.views import Camera
from neilfpp_method.relight.cameras import rays_through
from neilfpp_method.relight.path_tracer import DIMENSIONS, Scene, trace_paths
from neilfpp_method.relight.sequence import Numbers, Sequence

__all__ = ["Budget", "Picture", "take_picture"]

PATHS_AT_ONCE = 2**16
"""Bounds the memory, some 100 MB; fewer are slower, more are not faster."""
ENOUGH = 2**20
"""Samples of a pixel where only the time bounds them."""
PLACE_IN_PIXEL = 2
"""Dimensions of the sequence that come first."""


@dataclass(frozen=True)
class Budget:
    """When a picture is done: after so many samples per pixel, or at the end of the pass in which the seconds
    are over; whichever comes first. Each pixel has one sample at least."""

    samples: int | None
    seconds: float | None = None


@dataclass(frozen=True)
class Picture:
    """Linear radiance, premultiplied: 0 where no surface is; the share of a pixel that a surface covers;
    reflectance and normal for a denoiser; and how many samples each pixel had."""

    radiance: Float[Tensor, "H W 3"]
    alpha: Float[Tensor, "H W 1"]
    albedo: Float[Tensor, "H W 3"]
    normal: Float[Tensor, "H W 3"]
    samples: int


def take_picture(
    scene: Scene,
    camera: Camera,
    budget: Budget,
    bounces: int,
    seed: int = 0,
    on_progress: Callable[[float], None] = lambda share: None,
    clock: Callable[[], float] = time.monotonic,
) -> Picture:
    """A picture by path tracing, a box filter of one pixel.

    Args:
        scene: what there is; its device is where paths are traced.
        camera: in the scene frame.
        budget: of this picture.
        bounces: see `trace_paths`.
        seed: the same seed and number of samples give the same picture.
        on_progress: told the share of the picture that is done.
        clock: seconds.
    """
    device = scene.sky.radiance.device
    pixels, begun = camera.width * camera.height, clock()
    most = budget.samples or ENOUGH
    sequence = Sequence(PLACE_IN_PIXEL + bounces * DIMENSIONS, seed)
    sums = torch.zeros(pixels, 10, dtype=torch.float64, device=device)
    done = 0
    while done < most:
        passed = clock() - begun
        if done and budget.seconds is not None and passed >= budget.seconds:
            break
        block = min(max(1, PATHS_AT_ONCE // pixels), most - done)
        numbers = sequence.next(block, pixels, device)
        for paths in torch.arange(block * pixels, device=device).split(PATHS_AT_ONCE):
            part = numbers.of(paths)
            sums.index_add_(0, part.pixel, _samples(scene, camera, part, bounces))
            share = (done + (paths[-1].item() + 1) / pixels) / most
            spent = 0.0 if budget.seconds is None else (clock() - begun) / budget.seconds
            on_progress(min(1.0, max(share, spent)))
        done += block
    mean = (sums / done).float().view(camera.height, camera.width, 10)
    radiance, alpha, albedo, normal = mean.split([3, 1, 3, 3], dim=-1)
    return Picture(radiance, alpha, albedo, normal, done)


def _samples(scene: Scene, camera: Camera, numbers: Numbers, bounces: int) -> Float[Tensor, "N 10"]:
    paths = torch.arange(len(numbers.pixel), device=numbers.pixel.device)
    corner = torch.stack((numbers.pixel % camera.width, numbers.pixel // camera.width), -1)
    rays, shown = rays_through(camera, corner + numbers.at(paths, 0, PLACE_IN_PIXEL))
    traced = trace_paths(scene, rays, numbers, bounces, PLACE_IN_PIXEL)
    values = torch.cat((traced.radiance, traced.alpha[:, None], traced.albedo, traced.normal), -1)
    return (values * shown[:, None]).double()
