"""Image gradients need nine reads per pixel: they are computed only in steps whose losses use them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from neilfpp_method.data.pixels import dataset
from neilfpp_method.train.loop import train
from tests.data.make_capture import make_capture
from tests.train.small_runs import small_config, small_training


@pytest.mark.parametrize(
    ("smoothness", "drawn"), [(0.0, 0), (5e-4, 8 * 48)]
)  # eight steps of 48 rays move the material
def test_gradients_are_computed_where_a_loss_needs_them(
    tmp_path: Path, monkeypatch, smoothness: float, drawn: int
) -> None:
    counted: list[int] = []
    computed = dataset.scharr
    monkeypatch.setattr(dataset, "scharr", lambda about: counted.append(about[0].numel()) or computed(about))
    config = small_config(sdf_steps=4, material_steps=4, joint_steps=4)
    config = replace(config, loss=replace(config.loss, smoothness=smoothness))
    training = small_training(make_capture(tmp_path / "capture"), tmp_path / "run", config)
    counted.clear()
    train(training)
    assert sum(counted) == drawn
