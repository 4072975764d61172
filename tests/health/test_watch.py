"""Findings on models that are fog and on models with a surface, and findings that are dropped later."""

from __future__ import annotations

import pytest
import torch

from neilfpp_method.data.files.json_entry import write_json
from neilfpp_method.errors import UserError
from neilfpp_method.health.measure import measure_surface
from neilfpp_method.health.watch import Watch
from neilfpp_method.schedule import STAGES, Stage
from neilfpp_method.structures import PixelBatch, SurfaceHits
from neilfpp_method.train.health_record import read_findings, write_findings
from tests.scenes import sphere_batch, sphere_model

PIXELS = sphere_batch(spread=0.1)
"""All of them meet the sphere."""


def test_a_shell_in_front_of_its_point_cloud_is_a_finding():
    """The surface of the model has a radius of 0.6."""
    model = sphere_model()
    direction = torch.nn.functional.normalize(torch.randn(30_000, 3), dim=-1)
    for radius, cases in ((0.58, []), (0.3, ["off_point_cloud"])):
        model.host.point_position, model.host.point_normal = radius * direction, direction
        watch = Watch(PIXELS, print, print)
        watch.after_stage(model, STAGES[Stage.SDF_INIT], 0, 40)
        assert list(watch.findings) == cases
    assert watch.record()["verdict"] == "failed"


def hits_of(batch: PixelBatch, opacity: float, concentration: float) -> SurfaceHits:
    ones = torch.ones(len(batch.origins))
    return SurfaceHits(batch.color, batch.origins, -batch.directions, opacity * ones, concentration * ones)


def showing(opacity: float, concentration: float):
    """A model whose host shows fog, nothing, or a surface."""
    model = sphere_model()
    model.host.render = lambda rays: hits_of(PIXELS, opacity, concentration)
    return model


@pytest.mark.parametrize(
    ("opacity", "concentration", "case"), [(1.0, 1.0, None), (1.0, 0.1, "fog"), (0.0, 0.0, "no_surface")]
)
def test_a_measurement_distinguishes_surface_fog_and_empty_space(opacity, concentration, case):
    said: list[str] = []
    watch = Watch(PIXELS, said.append, print)
    watch.after_stage(showing(opacity, concentration), STAGES[Stage.SDF_INIT], 0, 40)
    assert list(watch.findings) == ([case] if case else [])
    assert len(said) == len(watch.findings)
    assert watch.record()["verdict"] == ("failed" if case else "sound")


def test_a_finding_that_is_not_confirmed_is_dropped_and_warnings_are_not_repeated():
    warned: list[str] = []
    said: list[str] = []
    watch = Watch(PIXELS, warned.append, said.append)
    for _ in range(2):
        watch.after_stage(showing(1.0, 0.1), STAGES[Stage.SDF_INIT], 0, 40)
    assert len(warned) == 1
    assert said == []
    for _ in range(2):
        watch.after_stage(showing(1.0, 1.0), STAGES[Stage.JOINT], 0, 80)
    assert watch.record()["verdict"] == "sound"
    assert len(warned) == 1
    assert said == ["recovered after step 40: fog is no longer found"]


def test_steps_that_shade_nothing_are_counted_in_material_stages():
    model, said = sphere_model(), []
    watch = Watch(PIXELS, said.append, print)
    away = PIXELS[:0]
    for step in range(60):
        watch.after_step(STAGES[Stage.SDF_INIT], model.step(away, Stage.SDF_INIT), step)
    assert not said
    empty = model.step(away, Stage.MATERIAL_INIT)
    for step in range(60):
        watch.after_step(STAGES[Stage.MATERIAL_INIT], empty, step)
    assert len(said) == 1
    assert "no surface point was shaded" in said[0]


def test_a_measurement_keeps_the_mode_of_the_model():
    for training in (True, False):
        model = sphere_model().train(training)
        measure_surface(model, PIXELS, with_material=True)
        assert model.training is training


def test_the_record_is_read_back(tmp_path):
    watch = Watch(PIXELS, print, print)
    assert read_findings(tmp_path) is None
    watch.after_fit(3, 100)
    write_findings(tmp_path, watch)
    assert read_findings(tmp_path) == list(watch.findings.values())
    write_json(tmp_path / "health.json", {"format": 99})
    with pytest.raises(UserError, match="another version"):
        read_findings(tmp_path)
