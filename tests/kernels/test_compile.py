"""torch.compile of whole steps does not trace into loops that are compiled already.

This test runs in a separate process, because torch.compile cannot trace the type checkers of the tests.
"""

from __future__ import annotations

import subprocess
import sys

STEP = """
import torch
from torch._dynamo.utils import counters
from neilfpp_method.kernels import encode, grid_spec
from neilfpp_method.kernels.softplus import softplus, softplus_and_slope
from neilfpp_method.volume.distance_grid import sample_grid, trace_grid

spec = grid_spec(levels=2, log2_entries=8, max_resolution=32)
table = torch.rand(spec.entries, spec.features)
ball = sample_grid(lambda x: x.norm(dim=-1) - 0.5, 1.0, 12, torch.zeros(1))
start, up = torch.tensor([0.0, 0.0, -0.9]), torch.eye(3)[2].expand(6, 3)

def step(x):
    units = softplus_and_slope(x, 100.0)
    features = encode(x, table, spec, True)
    traced = trace_grid(ball, 1.0, 0.1 * x.detach() + start, up).distance
    parts = units.value * units.slope, softplus(x.detach(), 100.0), features.features, traced
    return sum(part.sum() for part in parts)

x = torch.rand(6, 3).requires_grad_()
compiled, plain = torch.compile(step, backend="eager")(x), step(x)
torch.testing.assert_close(compiled, plain)
torch.testing.assert_close(torch.autograd.grad(compiled, x), torch.autograd.grad(plain, x))
print(counters["stats"]["unique_graphs"], *counters["graph_break"])
"""


def test_a_compiled_step_does_not_trace_into_numba():
    done = subprocess.run([sys.executable, "-c", STEP], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
    assert int(done.stdout.split()[0]) > 0
    for into in ("CPUDispatcher", "numba", "llvmlite", "ThreadPoolExecutor", "get_num_threads"):
        assert into not in done.stdout
