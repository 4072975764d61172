"""Attach material and light to a rasteriser that renders whole images, such as Gaussian splatting."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from torch import nn
from torch.nn.functional import normalize

from neilfpp_method import attach_neilf, preset
from neilfpp_method.attach import pixel_batch
from neilfpp_method.data.cameras.camera import Camera
from neilfpp_method.data.cameras.projection import camera_rays
from neilfpp_method.hosts.image import image_hits
from neilfpp_method.settings.types import LightFitConfig


class Surfels(nn.Module):
    """Stand-in for your splats: soft discs on a ball. A rasteriser needs one method, `render_image`."""

    def __init__(self, count: int = 300) -> None:
        super().__init__()
        self.normal = normalize(torch.randn(count, 3), dim=-1)
        self.paint = nn.Parameter(torch.zeros(count, 3))

    def render_image(self, camera: Camera):
        rays, forward = camera_rays(camera), torch.tensor(camera.w2c[2, :3], dtype=torch.float32)
        center, slope = 0.5 * self.normal, rays.directions @ self.normal.T
        faces = slope < -0.05
        reach = (center * self.normal).sum(-1) - rays.origins @ self.normal.T
        distance = torch.where(faces, reach / torch.where(faces, slope, -1.0), 10.0)
        offset = rays.origins[:, None] + distance[..., None] * rays.directions[:, None] - center
        alpha = (-offset.square().sum(-1) / 0.1**2).exp() * faces
        nearest = torch.where(alpha > 0.05, distance, 10.0).amin(-1, keepdim=True)
        weight = alpha * (20.0 * (nearest - distance)).clamp_max(5.0).exp() + 1e-12
        weight = weight / weight.sum(-1, keepdim=True)
        size, opacity = (camera.height, camera.width), (2 * alpha.amax(-1)).clamp_max(1.0)
        depth = (weight * distance).sum(-1) * (rays.directions @ forward)
        color = (weight @ self.paint.exp()) * opacity[:, None]
        return image_hits(camera, color.view(*size, 3), depth.view(size), opacity.view(size))


def camera_at(eye, size: int = 32) -> Camera:
    forward = -eye / np.linalg.norm(eye)
    right = np.cross(forward, [0.0, 0.0, 1.0]) / np.linalg.norm(np.cross(forward, [0.0, 0.0, 1.0]))
    w2c = np.eye(4)
    w2c[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    w2c[:3, 3] = -w2c[:3, :3] @ eye
    return Camera(1.8 * size, 1.8 * size, size / 2, size / 2, size, size, w2c)


torch.manual_seed(0)
host, red = Surfels(), torch.tensor([0.4, 0.1, 0.05])
cameras = [camera_at(2.5 * np.array([np.cos(a), np.sin(a), 0.4])) for a in np.arange(0.0, 6.0, 1.0)]
settings = preset("fast")
fit = LightFitConfig(points=128, every=30)  # a small map that is fitted rarely keeps this example short
settings = dataclasses.replace(
    settings,
    light=dataclasses.replace(settings.light, kind="distant", environment_height=8, fit=fit),
    shading=dataclasses.replace(settings.shading, train_samples=16),
    train=dataclasses.replace(settings.train, sdf_steps=0, material_steps=60),
)
optimizer = torch.optim.Adam(host.parameters(), lr=1e-1)
neilf = attach_neilf(host, settings, median_radiance=0.2)  # 1
for group in neilf.param_groups():  # 2
    optimizer.add_param_group(group)
for step in range(36):
    rays, hits = camera_rays(camera := cameras[step % 6]), host.render_image(camera)
    # The photograph: a red ball under a soft sky.
    photograph = (0.7 + 0.3 * hits.normal[:, 2:]) * red * hits.opacity[:, None].detach()
    own, rows = (hits.color - photograph).abs().mean(), torch.randperm(len(rays))[:200]
    batch = pixel_batch(rays.origins, rays.directions, photograph.detach())[rows]
    total = neilf.losses(batch, step, hits[rows])  # pass the rendered hits, so nothing is rendered twice
    optimizer.zero_grad()
    (own + total.loss).backward()  # 3
    optimizer.step()
print({name: round(value.item(), 3) for name, value in total.terms.items()}, "|", neilf.proxy.report())
