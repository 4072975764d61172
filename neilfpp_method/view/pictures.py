"""From a wish to ever finer pictures: by layer, in parts that are small enough to be given up."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from neilfpp_method.data.views import Camera
from neilfpp_method.evaluate.pictures import display, display_color
from neilfpp_method.relight.cameras import rays_through, resized
from neilfpp_method.relight.path_tracer import DIMENSIONS, trace_paths
from neilfpp_method.relight.sequence import Sequence
from neilfpp_method.structures import RayBatch
from neilfpp_method.view.pace import Pace, sizes
from neilfpp_method.view.subject import Lighting, Subject, scene_of

__all__ = ["Frame", "Wish", "frames"]

BOUNCES = 4
SAMPLES = 256
"""Of a pixel, after which a picture is as good as it gets."""
SEED = 0
PAPER = 0.93
"""Grey of what lies behind a surface, on the screen."""
FAR = 100.0
"""Scene units: the depth of what is no surface, for the browser's own objects."""


@dataclass(frozen=True, eq=False)
class Wish:
    """What a browser wants to see.

    Attributes:
        subject: of what.
        camera: a pinhole of the size of the window, scene frame.
        layer: one of the subject's.
        light: for the layer PBR.
        exposure: stops by which radiance is shown brighter.
        sky_behind: show the map behind the surface, in the layer PBR.
    """

    subject: Subject
    camera: Camera
    layer: str
    light: Lighting
    exposure: float = 0.0
    sky_behind: bool = False


@dataclass(frozen=True, eq=False)
class Frame:
    """A picture of a wish, perhaps smaller than the window: sRGB, and axial depths, scene units.

    `share` is its size over that of the window, `samples` how many each pixel has.
    """

    image: UInt8[np.ndarray, "H W 3"]
    depth: Float[np.ndarray, "H W"]
    share: float
    samples: int


Part = Callable[[RayBatch, Tensor], Tensor]
"""Rays, and their numbers in the picture, to RGB and opacity, (N, 4)."""


def frames(wish: Wish, pace: Pace) -> Iterator[Frame | None]:
    """Ever finer pictures; None between parts of one, where it can be given up.

    Args:
        wish: what is shown.
        pace: how fast this machine is, by layer; measurements are added to it.
    """
    traced = wish.layer == "pbr" and wish.light.sky is not None
    for share in sizes(wish.camera.width, wish.camera.height, pace.at_once(wish.layer)):
        camera = resized(wish.camera, share)
        total = None
        for sample in range(SAMPLES if traced and share == 1 else 1):
            part = _paths(wish, camera, sample) if traced else _still(wish)
            values = None
            for values in _whole(wish, camera, part, pace, jitter=sample if traced else 0):
                if values is None:
                    yield None
            total = values if total is None else total + values
            yield _frame(wish, camera, total / (sample + 1), share, sample + 1)


def _whole(wish: Wish, camera: Camera, part: Part, pace: Pace, jitter: int) -> Iterator[Tensor | None]:
    """None after each part but the last, then all pixels; the first sample is at each pixel's centre."""
    layer, device = wish.layer, wish.subject.device
    pixels = torch.arange(camera.width * camera.height, device=device)
    inside = (
        torch.rand(2, generator=torch.Generator().manual_seed(jitter)) if jitter else torch.full((2,), 0.5)
    )
    inside = inside.to(device)
    done, start = [], 0
    while start < len(pixels):
        rows = pixels[start : start + pace.together(layer)]
        begun = time.perf_counter()
        corner = torch.stack((rows % camera.width, rows // camera.width), -1)
        rays, _ = rays_through(camera, corner + inside)
        with torch.no_grad():
            done.append(part(rays, rows).cpu())  # waits for the device, so the time is that of the work
        pace.note(layer, len(rows), time.perf_counter() - begun)
        start += len(rows)
        if start < len(pixels):
            yield None
    yield torch.cat(done)


def _paths(wish: Wish, camera: Camera, sample: int) -> Part:
    """Light along paths, one for each pixel."""
    scene, pixels = scene_of(wish.subject, wish.light), camera.width * camera.height
    numbers = Sequence(BOUNCES * DIMENSIONS, SEED + sample).next(1, pixels, wish.subject.device)

    def part(rays: RayBatch, rows: Tensor) -> Tensor:
        found = trace_paths(scene, rays, numbers.of(rows), BOUNCES)
        color, alpha = found.radiance, found.alpha[:, None]
        if wish.sky_behind:
            color, alpha = color + (1 - alpha) * scene.sky.look(rays.directions), torch.ones_like(alpha)
        return torch.cat((color, alpha), -1)

    return part


def _still(wish: Wish) -> Part:
    """What is the same at every look."""
    subject, layer = wish.subject, wish.layer
    model = subject.run.model
    if layer == "radiance":
        return lambda rays, rows: _with_alpha(
            model.host.render(rays).color, torch.ones_like(rays.origins[:, :1])
        )

    def part(rays: RayBatch, rows: Tensor) -> Tensor:
        met = subject.surface.cross(rays.origins, rays.directions)
        met = met[torch.nonzero(met.outside)[:, 0]]
        shown = rays.origins.new_zeros(len(rays), 4)
        if not len(met.rows):
            return shown
        if layer == "normal":
            value = met.normal
        else:
            material = model.materials(met.position)
            if layer == "pbr":
                wo = -rays.directions[met.rows]
                value = model.shade(
                    met.position, met.normal, wo, material, model.config.shading.eval_samples
                ).color
            else:
                value = getattr(material, layer).expand(-1, 3)
        shown[met.rows] = _with_alpha(value, torch.ones_like(value[:, :1]))
        return shown

    return part


def _with_alpha(color: Tensor, alpha: Tensor) -> Tensor:
    return torch.cat((color, alpha), -1)


def _frame(wish: Wish, camera: Camera, values: Float[Tensor, "P 4"], share: float, samples: int) -> Frame:
    shape = (camera.height, camera.width)
    alpha = values[:, 3:].clamp(0, 1)
    shown = (values[:, :3] / alpha.clamp_min(1e-6)).view(*shape, 3).numpy()
    if wish.layer in ("pbr", "radiance"):
        image = display_color(shown, 2.0**wish.exposure)
    elif wish.layer in ("roughness", "metallic"):
        image = display(wish.layer, shown[..., :1]).repeat(3, -1)
    else:
        image = display(wish.layer, shown)
    covered = alpha.view(*shape, 1).numpy()
    image = np.rint(covered * image + (1 - covered) * 255 * PAPER).astype(np.uint8)
    return Frame(image, _depth(wish.subject, camera), share, samples)


def _depth(subject: Subject, camera: Camera) -> Float[np.ndarray, "H W"]:
    pixels = torch.arange(camera.width * camera.height, device=subject.device)
    depth = torch.full((len(pixels),), FAR, device=subject.device)
    if subject.surface is not None:
        rays, _ = rays_through(camera, torch.stack((pixels % camera.width, pixels // camera.width), -1) + 0.5)
        met = subject.surface.cross(rays.origins, rays.directions)
        forward = torch.from_numpy(camera.w2c[2, :3].astype(np.float32)).to(subject.device)
        depth[met.rows] = met.distance * (rays.directions[met.rows] @ forward)
    return depth.view(camera.height, camera.width).cpu().numpy()
