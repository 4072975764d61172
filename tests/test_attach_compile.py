"""`torch.compile` of a training step compiles the code of its author, and not the attached module.

This test runs in a separate process, because torch.compile cannot trace the type checkers of the tests.
"""

from __future__ import annotations

import subprocess
import sys

STEP = """
import torch
from torch._dynamo.utils import counters
from neilfpp_method.attach import attach_neilf, pixel_batch
from tests.hosts.balls import Ball, ball_rays
from tests.scenes import tiny_config

rays = ball_rays(16, 0.3, 0)
batch = pixel_batch(rays.origins, rays.directions, torch.full((16, 3), 0.3))

def loss_of(neilf):
    torch.manual_seed(0)
    return float(neilf(batch, "joint").loss.detach())

torch.manual_seed(1)
neilf = attach_neilf(Ball(), tiny_config()).eval()
plain, compiled = loss_of(neilf), loss_of(torch.compile(neilf, backend="eager"))
assert plain == compiled, (plain, compiled)
maps = torch.compile(neilf.maps, backend="eager")(rays)
print("traced", counters["stats"]["calls_captured"])

counters.clear()
neilf, own = attach_neilf(torch.compile(Ball(), backend="eager"), tiny_config()), torch.nn.Linear(3, 3)

@torch.compile(backend="eager")
def step():
    return own(batch.directions).square().mean() + neilf.losses(batch, "joint").loss

step().backward()
assert own.weight.grad.abs().sum() > 0
print("of the author", counters["stats"]["calls_captured"])
"""


def test_a_compiled_step_does_not_trace_the_attached_module():
    done = subprocess.run([sys.executable, "-c", STEP], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
    traced, of_the_author = (int(line.split()[-1]) for line in done.stdout.splitlines())
    assert traced == 0
    assert 0 < of_the_author < 200, "the linear layer and the host"
