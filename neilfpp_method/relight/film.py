"""Render an image by path tracing: accumulate samples until their number or the time limit is reached."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from time import monotonic

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.data.cameras.camera import Camera
from neilfpp_method.relight.cameras import pixel_rays
from neilfpp_method.relight.path_tracer import DIMENSIONS, Scene, trace_paths
from neilfpp_method.relight.sequence import Numbers, SobolSequence

__all__ = ["Budget", "Picture", "render_picture"]

PATHS_AT_ONCE = 2**16
"""Number of paths per batch. It bounds the memory to about 100 MB; fewer are slower, more are not faster."""
MAX_SAMPLES = 2**20
"""Largest number of samples per pixel if only a time limit is given."""
PIXEL_DIMENSIONS = 2
"""Number of leading dimensions of the sequence that give the position within a pixel."""


@dataclass(frozen=True)
class Budget:
    """Limits of the work on an image; rendering stops at whichever is reached first, after at least one pass.

    Attributes:
        samples: number of samples per pixel; None for no limit.
        seconds: time after which no new pass begins; None for no limit.
    """

    samples: int | None
    seconds: float | None = None


@dataclass(frozen=True)
class Picture:
    """A rendered image.

    Attributes:
        radiance: linear radiance, premultiplied by alpha.
        alpha: fraction of a pixel that the surface covers.
        albedo: reflectance, for a denoiser.
        normal: normals, for a denoiser.
        samples: number of samples per pixel.
    """

    radiance: Float[Tensor, "H W 3"]
    alpha: Float[Tensor, "H W 1"]
    albedo: Float[Tensor, "H W 3"]
    normal: Float[Tensor, "H W 3"]
    samples: int


def render_picture(
    scene: Scene,
    camera: Camera,
    budget: Budget,
    bounces: int,
    seed: int = 0,
    on_progress: Callable[[float], None] = lambda share: None,
) -> Picture:
    """Render an image by path tracing, with a box filter of one pixel.

    Args:
        scene: the scene; paths are traced on its device.
        camera: the camera, scene frame.
        budget: limits of samples and time.
        bounces: largest number of surface vertices of a path (`trace_paths`).
        seed: the same seed and number of samples give the same image.
        on_progress: called with the fraction of the work that is done.

    Example::

        surface, sky = surface_of_run(run, resolution=256), sky_of_run(run.model.light)
        scene = Scene(surface, run.model.materials, run.model.lobe, sky)
        picture = render_picture(scene, camera, Budget(samples=64), bounces=4)
    """
    device = scene.sky.radiance.device
    pixels, begun = camera.width * camera.height, monotonic()
    max_samples = budget.samples or MAX_SAMPLES
    sequence = SobolSequence(PIXEL_DIMENSIONS + bounces * DIMENSIONS, seed)
    sums = torch.zeros(pixels, 10, dtype=torch.float64, device=device)
    done = 0
    while done < max_samples:
        elapsed = monotonic() - begun
        if done and budget.seconds is not None and elapsed >= budget.seconds:
            break
        block = min(max(1, PATHS_AT_ONCE // pixels), max_samples - done)
        numbers = sequence.next(block, pixels, device)
        for paths in torch.arange(block * pixels, device=device).split(PATHS_AT_ONCE):
            part = numbers.of(paths)
            sums.index_add_(0, part.pixel, _samples(scene, camera, part, bounces))
            of_samples = (done + (paths[-1].item() + 1) / pixels) / max_samples
            of_time = 0.0 if budget.seconds is None else (monotonic() - begun) / budget.seconds
            on_progress(min(1.0, max(of_samples, of_time)))
        done += block
    mean = (sums / done).float().view(camera.height, camera.width, 10)
    radiance, alpha, albedo, normal = mean.split([3, 1, 3, 3], dim=-1)
    return Picture(radiance, alpha, albedo, normal, done)


def _samples(scene: Scene, camera: Camera, numbers: Numbers, bounces: int) -> Float[Tensor, "N 10"]:
    """Radiance, alpha, albedo and normal of one sample for each path."""
    paths = torch.arange(len(numbers.pixel), device=numbers.pixel.device)
    drawn = pixel_rays(camera, numbers.pixel, numbers.at(paths, 0, PIXEL_DIMENSIONS))
    traced = trace_paths(scene, drawn.rays, numbers, bounces, PIXEL_DIMENSIONS)
    values = torch.cat((traced.radiance, traced.alpha[:, None], traced.albedo, traced.normal), -1)
    return (values * drawn.valid[:, None]).double()
