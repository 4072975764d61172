"""`neilfpp relight` of a run whose distance field has no surface."""

from __future__ import annotations

import numpy as np

from neilfpp_method.data.files.images import write_exr
from tests.calls import refused, train_tiny
from tests.export.empty_field import without_surface
from tests.train.small_runs import few_steps


def test_a_run_without_a_surface_is_refused(masked_capture, tmp_path, capfd):
    run = without_surface(
        train_tiny(masked_capture, tmp_path / "found", config=few_steps), tmp_path / "empty"
    )
    write_exr(tmp_path / "sky.exr", {"RGB": np.ones((8, 16, 3), np.float32)})
    command = [
        "relight",
        run,
        "--env",
        tmp_path / "sky.exr",
        "--spp",
        4,
        "--resolution",
        32,
        "--device",
        "cpu",
    ]
    words = ("no surface within", "train the stage sdf_init for longer")
    refused(capfd, command, *words, leaves=tmp_path)
