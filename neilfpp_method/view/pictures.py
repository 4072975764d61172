"""Render a layer of a run as successively finer images, in small batches between which rendering may stop."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from neilfpp_method.data.cameras.camera import Camera
from neilfpp_method.evaluate.pictures import display, display_color, display_error
from neilfpp_method.relight.cameras import pixel_rays, resized
from neilfpp_method.relight.path_tracer import DIMENSIONS, trace_paths
from neilfpp_method.relight.sequence import SobolSequence
from neilfpp_method.relight.surface import Intersections
from neilfpp_method.structures import RayBatch
from neilfpp_method.view.speed import RenderSpeed, sizes
from neilfpp_method.view.subject import ERROR_LAYERS, Lighting, Subject, scene_of

__all__ = ["PictureRequest", "ViewerFrame", "frames"]

BOUNCES = 4
"""Largest number of surface vertices of a path."""
SAMPLES = 256
"""Number of samples per pixel after which an image is finished; more would not change it visibly."""
SEED = 0
"""Seed of the first sample."""
PAPER = 0.93
"""Grey of the background, as a display value in [0, 1]."""
LARGEST_ERROR = 0.5
"""Expected error from which a pixel has the brightest colour."""
FAR_DEPTH = 100.0
"""Depth of pixels without a surface, scene units; the browser's own objects appear in front of it."""


@dataclass(frozen=True, eq=False)
class PictureRequest:
    """The view that a browser requests.

    Attributes:
        subject: the run.
        camera: a pinhole camera of the size of the window, scene frame.
        layer: one of the subject's layers.
        light: the light for the layer PBR.
        exposure: stops by which radiance is brightened.
        sky_behind: whether the layer PBR shows the environment map behind the surface.
    """

    subject: Subject
    camera: Camera
    layer: str
    light: Lighting
    exposure: float = 0.0
    sky_behind: bool = False


@dataclass(frozen=True, eq=False)
class ViewerFrame:
    """A rendered image, which may be smaller than the window.

    Attributes:
        image: sRGB bytes.
        depth: depth along the camera's axis, scene units.
        share: size relative to that of the window.
        samples: number of samples per pixel.
    """

    image: UInt8[np.ndarray, "H W 3"]
    depth: Float[np.ndarray, "H W"]
    share: float
    samples: int


Shader = Callable[[RayBatch, Tensor], Tensor]
"""Maps rays and their pixel indices to RGB and opacity, (N, 4)."""


def frames(request: PictureRequest, speed: RenderSpeed) -> Iterator[ViewerFrame | None]:
    """Yield successively finer images of a request, and None between batches, when rendering may stop.

    Args:
        request: the view to render.
        speed: rendering speed of this machine, to which measurements are added.
    """
    traced = request.layer == "pbr" and request.light.sky is not None
    for share in sizes(request.camera.width, request.camera.height, speed.first_image(request.layer)):
        camera = resized(request.camera, share)
        total, depth = None, None
        for sample in range(SAMPLES if traced and share == 1 else 1):
            shader = _path_shader(request, camera, sample) if traced else _layer_shader(request)
            values = yield from _render(request, camera, shader, speed, jitter=sample if traced else 0)
            total = values if total is None else total + values
            depth = _depth(request.subject, camera) if depth is None else depth
            image = _image(request, total / (sample + 1), depth.shape)
            yield ViewerFrame(image, depth, share, samples=sample + 1)


def _render(
    request: PictureRequest, camera: Camera, shader: Shader, speed: RenderSpeed, jitter: int
) -> Generator[None, None, Float[Tensor, "P 4"]]:
    """Yield None after each batch but the last, and return RGB and opacity of all pixels.

    `jitter` seeds the position of the rays within their pixels; 0 stands for the centre.
    """
    layer, device = request.layer, request.subject.device
    pixels = torch.arange(camera.width * camera.height, device=device)
    if jitter:
        position = torch.rand(2, generator=torch.Generator().manual_seed(jitter)).to(device)
    else:
        position = torch.full((2,), 0.5, device=device)
    done, start = [], 0
    while start < len(pixels):
        rows = pixels[start : start + speed.batch(layer)]
        begun = time.perf_counter()
        rays = pixel_rays(camera, rows, position).rays
        # The copy to the CPU waits for the device, so that the measured time is that of the work.
        with torch.no_grad():
            done.append(shader(rays, rows).cpu())
        speed.note(layer, len(rows), time.perf_counter() - begun)
        start += len(rows)
        if start < len(pixels):
            yield None
    return torch.cat(done)


def _path_shader(request: PictureRequest, camera: Camera, sample: int) -> Shader:
    """A shader that traces one path per pixel."""
    scene, pixels = scene_of(request.subject, request.light), camera.width * camera.height
    numbers = SobolSequence(BOUNCES * DIMENSIONS, SEED + sample).next(1, pixels, request.subject.device)

    def shade(rays: RayBatch, rows: Tensor) -> Tensor:
        traced = trace_paths(scene, rays, numbers.of(rows), BOUNCES)
        color, alpha = traced.radiance, traced.alpha[:, None]
        if request.sky_behind:
            color, alpha = color + (1 - alpha) * scene.sky.lookup(rays.directions), torch.ones_like(alpha)
        return torch.cat((color, alpha), -1)

    return shade


def _layer_shader(request: PictureRequest) -> Shader:
    """A deterministic shader of a layer."""
    subject, layer = request.subject, request.layer
    if layer == "radiance":
        return lambda rays, rows: _opaque(subject.run.model.host.render(rays).color)

    def shade(rays: RayBatch, rows: Tensor) -> Tensor:
        hits = subject.surface.intersect(rays.origins, rays.directions)
        hits = hits[torch.nonzero(hits.outside)[:, 0]]
        result = rays.origins.new_zeros(len(rays), 4)
        if len(hits.rows):
            result[hits.rows] = _opaque(_layer_at(subject, layer, hits, -rays.directions[hits.rows]))
        return result

    return shade


def _layer_at(
    subject: Subject, layer: str, hits: Intersections, wo: Float[Tensor, "K 3"]
) -> Float[Tensor, "K 3"]:
    """Values of a layer at hits of the surface that are seen from the directions wo."""
    model = subject.run.model
    if layer == "normal":
        return hits.normal
    if layer in ERROR_LAYERS:
        errors = subject.expected_errors.at(hits.position, hits.normal)
        return errors[:, ERROR_LAYERS.index(layer), None].expand(-1, 3)
    material = model.materials(hits.position)
    if layer == "pbr":
        return model.shade(hits.position, hits.normal, wo, material, model.config.shading.eval_samples).color
    return getattr(material, layer).expand(-1, 3)


def _opaque(color: Float[Tensor, "N 3"]) -> Float[Tensor, "N 4"]:
    return torch.cat((color, torch.ones_like(color[:, :1])), -1)


def _image(
    request: PictureRequest, values: Float[Tensor, "P 4"], shape: tuple[int, ...]
) -> UInt8[np.ndarray, "H W 3"]:
    """Convert RGB and opacity to an 8-bit image over the background."""
    alpha = values[:, 3:].clamp(0, 1)
    straight = (values[:, :3] / alpha.clamp_min(1e-6)).view(*shape, 3).numpy()
    if request.layer in ("pbr", "radiance"):
        image = display_color(straight, 2.0**request.exposure)
    elif request.layer in ERROR_LAYERS:
        image = display_error(straight[..., 0], LARGEST_ERROR)
    elif request.layer in ("roughness", "metallic"):
        image = display(request.layer, straight[..., :1]).repeat(3, -1)
    else:
        image = display(request.layer, straight)
    opacity = alpha.view(*shape, 1).numpy()
    return np.rint(opacity * image + (1 - opacity) * 255 * PAPER).astype(np.uint8)


def _depth(subject: Subject, camera: Camera) -> Float[np.ndarray, "H W"]:
    """Depth along the camera's axis; `FAR_DEPTH` without a surface."""
    pixels = torch.arange(camera.width * camera.height, device=subject.device)
    depth = torch.full((len(pixels),), FAR_DEPTH, device=subject.device)
    if subject.surface is not None:
        rays = pixel_rays(camera, pixels).rays
        hits = subject.surface.intersect(rays.origins, rays.directions)
        forward = torch.from_numpy(camera.w2c[2, :3].astype(np.float32)).to(subject.device)
        depth[hits.rows] = hits.distance * (rays.directions[hits.rows] @ forward)
    return depth.view(camera.height, camera.width).cpu().numpy()
