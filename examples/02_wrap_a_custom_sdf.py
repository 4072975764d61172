"""Use your own signed distance field as a host, and check it with `check_host`.

    python examples/02_wrap_a_custom_sdf.py

The host needs one method, `render`. This one also has `parameter_groups`, so it is trained with the material.
"""

from __future__ import annotations

import torch
from torch import nn
from torch.func import grad, vmap
from torch.nn.functional import normalize

from neilfpp_method import attach_neilf, preset
from neilfpp_method.attach import pixel_batch
from neilfpp_method.hosts.testing import check_host
from neilfpp_method.schedule import Stage
from neilfpp_method.settings.presets import free_light
from neilfpp_method.structures import RayBatch, SurfaceHits


class Blob(nn.Module):
    """A sphere with a learned offset, rendered by sphere tracing."""

    def __init__(self) -> None:
        super().__init__()
        self.offset = nn.Sequential(nn.Linear(3, 32), nn.Softplus(beta=20.0), nn.Linear(32, 1))
        self.paint = nn.Sequential(nn.Linear(6, 32), nn.ReLU(), nn.Linear(32, 3), nn.Softplus())

    def sdf(self, x):
        return x.norm(dim=-1) - 0.5 + 0.1 * self.offset(x)[:, 0]

    def render(self, rays: RayBatch) -> SurfaceHits:
        with torch.no_grad():
            depth = torch.zeros_like(rays.origins[:, 0])
            for _ in range(40):
                depth = (depth + self.sdf(rays.origins + depth[:, None] * rays.directions)).clamp_max(6.0)
            x = rays.origins + depth[:, None] * rays.directions
        distance, gradient = self.sdf(x), vmap(grad(lambda point: self.sdf(point[None])[0]))(x)
        hit = distance.detach().abs() < 1e-3
        normal = torch.where(hit[:, None], normalize(gradient, dim=-1), 0.0)
        # The traced depth has no gradient; this line gives the position one: it slides along the ray.
        slope = (normal.detach() * rays.directions).sum(-1).clamp_max(-0.1)
        position = x - ((distance - distance.detach()) / slope)[:, None] * rays.directions
        color = torch.where(hit[:, None], self.paint(torch.cat([position, normal], dim=-1)), 0.0)
        return SurfaceHits(color, position, normal, hit.to(color.dtype), hit.to(color.dtype))

    # A host with this method is trained together with the material; without it, the host is borrowed.
    def parameter_groups(self):
        return {"geometry": list(self.offset.parameters()), "radiance": list(self.paint.parameters())}


origins = 3.0 * normalize(torch.randn(256, 3), dim=-1)
rays = RayBatch(origins, normalize(0.3 * torch.randn(256, 3) - origins, dim=-1))
batch = pixel_batch(rays.origins, rays.directions, torch.tensor([[0.4, 0.3, 0.2]]).expand(256, 3))
print(check_host(host := Blob(), rays))
# The free light of the paper is used, because the few steps here include no fit of an environment map.
neilf = attach_neilf(host, free_light(preset("fast")))
optimizer = torch.optim.Adam(neilf.parameters(), lr=2e-3)
for stage in Stage:
    for _ in range(30):
        optimizer.zero_grad()
        total = neilf.losses(batch, stage)
        total.loss.backward()
        optimizer.step()
    print(stage.value, {name: round(value.item(), 3) for name, value in total.terms.items()})
