"""Compare patches of the surface between views, to recover geometry where the images have texture.

At a surface point, the pixels around it in one view are mapped to another view through the tangent plane.
Position and normal are right where both patches correlate. L_vol cannot tell surfaces apart that are a
fraction of a pixel off, because R explains each view by itself; the correlation does not depend on R, on the
exposure or on the white balance (Fu et al. 2022, "Geo-Neus"; Darmon et al. 2022, "NeuralWarp").
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

from neilfpp_method.data.cameras.camera import Camera
from neilfpp_method.data.cameras.neighbors import choose_sources
from neilfpp_method.data.pixels.dataset import PixelDataset
from neilfpp_method.data.pixels.gray import gray_of
from neilfpp_method.fields.sdf import SdfSample
from neilfpp_method.shading.frame import safe_normalize
from neilfpp_method.structures import LossTerm, PixelBatch, SurfaceHits

__all__ = ["PatchViews", "patch_loss", "patch_views"]

HALF_WIDTH = 3
"""A patch has 2 · 3 + 1 pixels a side, like the windows of `prepare.plane_sweep`."""
CHOICE = 8
"""Largest number of views with which a view is compared in the course of a training."""
SOURCES = 4
"""Number of these that are drawn at random for every surface point of a step."""
BEST = 2
"""Number of these whose correlation counts, the highest ones: the point may be hidden in the others."""
MIN_CONTRAST = 0.01
"""Smallest standard deviation of a patch, for grey values in [0, 1]. Below it, noise decides."""
MIN_COSINE = 0.1
"""Smallest cosine between the tangent plane's normal and the rays of a patch."""
MIN_COSINE_OF_SOURCE = 0.2
"""Smallest cosine between the normal and the direction to a view that is compared."""
MAX_EXTENT = 0.3
"""Largest distance of a point of the patch from its centre, in scene units: larger surfaces are no planes."""
MAX_STEP = 0.05
"""Largest distance of a hit from the surface of G, in scene units: farther, they are not the same surface."""
TINY = 1e-10
"""Added to a product of variances before its root is taken, so that the gradient is finite."""


class PatchViews:
    """The training views as grey images, and which of them are compared.

    This is no module: the capture has the images, so they belong neither into checkpoints nor among the
    buffers that several processes synchronise.

    Args:
        images: grey values in [0, 1], one image per view.
        cameras: pinhole cameras of the images, in the scene frame.
        device: where patches are compared.
    """

    def __init__(
        self,
        images: Sequence[Float[np.ndarray, "H W"]],
        cameras: Sequence[Camera],
        device: torch.device | str = "cpu",
    ) -> None:
        sizes = [camera.width * camera.height for camera in cameras]
        starts = list(itertools.accumulate(sizes, initial=0))[:-1]
        gray = np.concatenate([image.ravel() for image in images])
        self.gray = torch.from_numpy(gray).half().to(device)
        self.start = torch.tensor(starts, device=device)
        self.size = torch.tensor([[camera.width, camera.height] for camera in cameras], device=device)
        intrinsics = np.stack([camera.intrinsics for camera in cameras])
        self.intrinsics = torch.from_numpy(intrinsics).float().to(device)
        sources = choose_sources(cameras, np.zeros(3), CHOICE)
        padded = [[*row, *[-1] * (CHOICE - len(row))] for row in sources]
        self.sources = torch.tensor(padded, device=device)
        self.pose(cameras)

    @property
    def any(self) -> bool:
        """Whether any two views are compared."""
        return bool((self.sources >= 0).any())

    def pose(self, cameras: Sequence[Camera]) -> None:
        """Use other poses of the cameras."""
        self.w2c = torch.from_numpy(np.stack([camera.w2c[:3] for camera in cameras])).to(self.intrinsics)
        self.eye = torch.from_numpy(np.stack([camera.c2w[:3, 3] for camera in cameras])).to(self.intrinsics)

    def disagreement(
        self, position: Float[Tensor, "N 3"], normal: Float[Tensor, "N 3"], view: Int[Tensor, " N"]
    ) -> Float[Tensor, " N"]:
        """One minus the correlation of the patches at surface points, in [0, 2], and its gradient.

        It is 0 where nothing can be compared: without texture, at the border of an image, or where no other
        view shows the point. The views are drawn with torch's global generator.

        Args:
            position: surface points, scene frame.
            normal: their unit normals.
            view: the view whose pixel shows each point.
        """
        steps = torch.arange(-HALF_WIDTH, HALF_WIDTH + 1.0, device=position.device)
        offsets = torch.cartesian_prod(steps, steps)
        with torch.no_grad():
            local = torch.einsum("nij,nj->ni", self.w2c[view][..., :3], position) + self.w2c[view][..., 3]
            focal, center = self.intrinsics[view].split(2, -1)
            pixel = (local[:, :2] / local[:, 2:] * focal + center)[:, None] + offsets
            plane = functional.pad((pixel - center[:, None]) / focal[:, None], (0, 1), value=1.0)
            rays = functional.normalize(plane @ self.w2c[view][..., :3], dim=-1)
            own, is_inside = self._at(pixel, view[:, None].expand(pixel.shape[:2]))
            source = self._drawn_sources(view)
        # Where the rays of the patch meet the tangent plane.
        slope = (rays * normal[:, None]).sum(-1)
        height = ((position - self.eye[view]) * normal).sum(-1, keepdim=True)
        points = self.eye[view][:, None] + (height / slope.clamp_max(-MIN_COSINE))[..., None] * rays
        extent = (points - position[:, None]).detach().norm(dim=-1)
        usable = is_inside & (slope < -MIN_COSINE) & (extent < MAX_EXTENT)
        error = self._error(own, points, source)
        facing = self._faces(position.detach(), normal.detach(), source)
        error = torch.where(facing & usable.all(-1, keepdim=True), error, torch.inf)
        best = error.topk(BEST, dim=1, largest=False).values
        return torch.where(best.isfinite(), best, 0.0).sum(1) / BEST

    def _drawn_sources(self, view: Int[Tensor, " N"]) -> Int[Tensor, "N S"]:
        """Random views with which each view is compared; −1 where it has fewer than `SOURCES`."""
        choice = self.sources[view]
        key = torch.rand(choice.shape, device=view.device).masked_fill(choice < 0, torch.inf)
        return choice.gather(1, key.argsort(1)[:, :SOURCES])

    def _faces(
        self, position: Float[Tensor, "N 3"], normal: Float[Tensor, "N 3"], source: Int[Tensor, "N S"]
    ) -> Bool[Tensor, "N S"]:
        """Whether a view exists and sees the front of a surface point."""
        towards = functional.normalize(self.eye[source] - position[:, None], dim=-1)
        return (source >= 0) & ((towards * normal[:, None]).sum(-1) > MIN_COSINE_OF_SOURCE)

    def _error(
        self, own: Float[Tensor, "N P"], points: Float[Tensor, "N P 3"], source: Int[Tensor, "N S"]
    ) -> Float[Tensor, "N S"]:
        """One minus the correlation of the patches in their own view and in others; infinite without one.

        Args:
            own: the patches in their own view.
            points: the points of the patches.
            source: the other views.
        """
        w2c, intrinsics = self.w2c[source], self.intrinsics[source][:, :, None]
        local = torch.einsum("nsij,npj->nspi", w2c[..., :3], points) + w2c[:, :, None, :, 3]
        depth = local[..., 2:]
        pixel = local[..., :2] / depth.clamp_min(TINY) * intrinsics[..., :2] + intrinsics[..., 2:]
        other, is_inside = self._at(pixel, source[..., None].expand(pixel.shape[:-1]))
        own, other = own - own.mean(-1, keepdim=True), other - other.mean(-1, keepdim=True)
        variance = own.square().mean(-1, keepdim=True)
        product = variance * other.square().mean(-1)
        error = 1.0 - (own[:, None] * other).mean(-1) / (product + TINY).sqrt()
        is_textured = variance > MIN_CONTRAST**2
        is_shown = (is_inside & (depth[..., 0] > 0)).all(-1)
        return torch.where(is_textured & is_shown, error, torch.inf)

    def _at(
        self, pixel: Float[Tensor, "*N 2"], view: Int[Tensor, "*N"]
    ) -> tuple[Float[Tensor, "*N"], Bool[Tensor, "*N"]]:
        """Grey values at image points, interpolated bilinearly, and whether the points are in the image."""
        size = self.size[view]
        # In pixels from the centre of the first pixel, away from NaN and infinity.
        free = torch.nan_to_num(pixel, nan=-1e6, posinf=1e6, neginf=-1e6) - 0.5
        is_inside = ((free >= 0) & (free <= size - 1)).all(-1)
        inside = torch.minimum(free.clamp_min(0.0), size - 1.0)
        corner = torch.minimum(inside.detach().floor().long(), (size - 2).clamp_min(0))
        across, down = (inside - corner).unbind(-1)
        width = size[..., 0]
        first = self.start[view] + corner[..., 1] * width + corner[..., 0]
        right, below = (size[..., 0] > 1).long(), torch.where(size[..., 1] > 1, width, 0)
        rows = (first, first + right, first + below, first + right + below)
        a, b, c, d = (self.gray[row].to(pixel.dtype) for row in rows)
        upper, lower = a + across * (b - a), c + across * (d - c)
        return upper + down * (lower - upper), is_inside


def patch_views(pixels: PixelDataset) -> PatchViews | None:
    """The training views for the comparison of patches; None if no two of them see the scene from nearby."""
    views = []
    for i, view in enumerate(pixels.views):
        camera = pixels.capture.scene_camera(view)
        color = pixels.store.view_colors(i).reshape(camera.height, camera.width, 3)
        views.append(gray_of(np.ascontiguousarray(color), camera, pixels.capture.hdr))
        pixels.store.release()
    compared = PatchViews([view.gray for view in views], [view.camera for view in views], pixels.device)
    return compared if compared.any else None


def patch_loss(
    views: PatchViews,
    field: Callable[[Float[Tensor, "P 3"]], SdfSample],
    hits: SurfaceHits,
    batch: PixelBatch,
    min_share: float,
) -> LossTerm:
    """L_patch: the disagreement of patches where the rays on the object meet the surface of G; 0 elsewhere.

    A blended hit is moved to the surface by one Newton step along its ray, whose derivative is that of the
    implicit surface.

    Args:
        views: the images that are compared.
        field: G with its gradient.
        hits: blended hits of the rays.
        batch: the pixels of the rays.
        min_share: see `SurfaceHits.is_hit`.
    """
    rows = torch.nonzero(hits.is_hit(min_share) & (batch.mask > 0.5))[:, 0]
    directions, start = batch.directions[rows], hits.position[rows].detach()
    sample = field(start)
    slope = (sample.gradient.detach() * directions).sum(-1)
    near = torch.nonzero((slope < -MIN_COSINE) & (sample.distance.detach().abs() < MAX_STEP))[:, 0]
    step = (sample.distance[near] / slope[near])[:, None] * directions[near]
    # Half precision is too coarse for projections.
    with torch.autocast(start.device.type, enabled=False):
        position, normal = (start[near] - step).float(), safe_normalize(sample.gradient[near].float())
        error = views.disagreement(position, normal, batch.view[rows[near]])
    return LossTerm(torch.zeros_like(hits.opacity).index_put((rows[near],), error.to(hits.opacity.dtype)))
