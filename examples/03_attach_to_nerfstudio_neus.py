"""Attach material and light to nerfstudio's NeuS: train NeuS first, then the material on top of it.

    python examples/03_attach_to_nerfstudio_neus.py [steps]

`steps`: of each of the two loops (default 2000). NeuS needs tiny-cuda-nn, and that a GPU.
"""

from __future__ import annotations

import dataclasses
import sys

import torch
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.models.neus import NeuSModelConfig

from neilfpp_method import attach_neilf, preset
from neilfpp_method.data.capture import load_capture
from neilfpp_method.data.pixels.dataset import PixelDataset
from neilfpp_method.demo.command import demo_scene
from neilfpp_method.hosts.nerfstudio import NerfstudioHost

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
STEPS = int(sys.argv[1]) if len(sys.argv) > 1 else 2000
RAYS = 128

capture = load_capture(demo_scene())
pixels = PixelDataset(capture, capture.train_views, device=DEVICE)
box = SceneBox(torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]))
neus = NeuSModelConfig().setup(scene_box=box, num_train_data=len(pixels.views)).to(DEVICE)

# Stand-in for your own trainer of the host.
trained = [p for group in neus.get_param_groups().values() for p in group if p.requires_grad]
optimizer = torch.optim.Adam(trained, 5e-4)
own = NerfstudioHost(neus, response="linear")
for _ in range(STEPS):
    rendered = own.render_regularized(batch := pixels.sample(RAYS), {"eikonal"})
    loss = (rendered.hits.color - batch.color).abs().mean() + 0.1 * rendered.terms["eikonal"].mean()
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()

# The add-on. The host is trained already, so the first stage has no steps. NeuS cannot trace rays cheaply, so
# a proxy of its surface traces shadows and inter-reflection.
config = preset("fast")
train = dataclasses.replace(config.train, sdf_steps=0, material_steps=STEPS)
config = dataclasses.replace(config, train=train)
neilf = attach_neilf(neus, config, response="linear", median_radiance=pixels.median_radiance()).to(DEVICE)
optimizer = torch.optim.Adam(neilf.param_groups())
for step in range(STEPS):
    loss = neilf.losses(pixels.sample(RAYS), step).loss
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
print(f"NeuS with material and light: loss {loss.item():.4f}; {neilf.proxy.report()}")
maps = neilf.eval().model.maps(pixels.sample(RAYS).rays)
seen = maps.roughness[:, 0] > 0
color = maps.base_color[seen].mean(0).tolist()
print(f"{int(seen.sum())} of {RAYS} rays meet one surface; mean base colour {color}")
