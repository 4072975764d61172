"""Trees of points whose smallest coordinates coincide, in processes that flush denormal numbers to 0."""

from __future__ import annotations

import subprocess
import sys

import numpy as np

from neilfpp_method.data.kd_tree import kd_tree

FLAT = """
import numpy as np
import torch
from neilfpp_method.data.kd_tree import kd_tree

torch.set_flush_denormal(True)
points = np.zeros((300_000, 4))
points[:, :2] = np.random.default_rng(0).random((len(points), 2))
points[: len(points) // 3, 3] = 5.0
distance, index = kd_tree(points).query(points[::100])
assert not distance.any() and (index == np.arange(0, len(points), 100)).all()
"""


def test_many_points_with_a_coordinate_of_0():
    """SciPy's default tree ends the process here: signal 11, without a traceback."""
    ended = subprocess.run([sys.executable, "-c", FLAT], capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr


def test_it_finds_the_nearest_points():
    drawn = np.random.default_rng(1)
    points, queries = drawn.normal(size=(500, 3)), drawn.normal(size=(50, 3))
    distance, index = kd_tree(points).query(queries)
    every = np.linalg.norm(queries[:, None] - points, axis=-1)
    assert (index == every.argmin(1)).all()
    np.testing.assert_allclose(distance, every.min(1))
