"""A mesh that does not lie where the photographs show the object is reported."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from neilfpp_method.data.capture import load_capture
from neilfpp_method.data.files.images import read_image, write_exr
from neilfpp_method.data.mesh import Mesh, read_mesh
from neilfpp_method.data.pixels.dataset import PixelDataset
from neilfpp_method.hosts.mesh import MeshHost
from neilfpp_method.train.build import scene_facts
from neilfpp_method.train.mesh_fit import MeshFit, measure_mesh_fit
from tests.data.make_capture import RADIUS, SCALE, make_capture
from tests.train.small_runs import small_config


def fit(root: Path, factor: float, shift: float) -> MeshFit:
    """The fit of the true sphere, in the scene frame, after it was scaled and moved."""
    capture, config = load_capture(root), small_config()
    pixels = PixelDataset(capture, capture.train_views)
    mesh = read_mesh(root / "inputs/model/mesh.ply", capture.normalization)
    moved = Mesh(factor * mesh.vertices + torch.tensor([shift, 0, 0]), mesh.faces)
    return measure_mesh_fit(MeshHost(moved, config, scene_facts(capture, pixels, config)), pixels)


# Beside the black background of one color, masks are not needed.
@pytest.mark.parametrize(("masks", "background"), [(True, 0.0), (True, 0.4), (False, 0.0)])
def test_a_true_mesh_fits_and_a_moved_one_does_not(tmp_path: Path, masks: bool, background: float) -> None:
    root = make_capture(tmp_path, size=(64, 48), masks=masks, background=background)
    true = fit(root, 1.0, 0.0)
    assert true.overlap > 0.97
    assert true.warning is None
    # The disk of the smaller sphere lies within that of the true one.
    assert fit(root, 0.8, 0.0).overlap == pytest.approx(0.64, abs=0.03)
    for factor, shift in ((SCALE / RADIUS, 0.0), (1 / SCALE, 0.0), (1.0, 0.3)):
        assert "intersection over union" in fit(root, factor, shift).warning


def test_without_masks_only_a_mesh_that_is_hardly_in_view_is_reported(tmp_path: Path) -> None:
    root = make_capture(tmp_path, size=(64, 48))
    noise = np.random.default_rng(0).uniform(0, 0.1, (48, 64, 3)).astype(np.float32)
    for path in (root / "inputs/images").iterdir():
        write_exr(path, {"RGB": read_image(path).pixels + noise})
    true = fit(root, 1.0, 0.0)
    assert (true.overlap, true.warning) == (None, None)
    assert "training pixels show the mesh" in fit(root, 0.05, 0.0).warning
